"""The documents, and what draws the picture of the folders: ``python -m docs.architecture``."""
