"""rl-zoo3 imports a module of this name, if there is one: a place to register environments."""

import sb3_options.envs  # noqa: F401  # registers them
