"""From a step map to a mean first-passage time: the mesh, its search, and the Markov chain."""
