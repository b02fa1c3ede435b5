"""A run and its folder: configuration, algorithms, evaluation. Needs tyro, PyYAML and imageio."""
