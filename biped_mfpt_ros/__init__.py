"""Mean first-passage time to a fall of a five-link biped that walks on rough ground."""

__version__ = "0.1.0"
