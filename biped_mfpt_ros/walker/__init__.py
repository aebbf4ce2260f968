"""The robot: links, dynamics, impact, terrain, and how a step can end."""
