"""Walking: one step under a controller, limit cycles, walks on random slopes."""
