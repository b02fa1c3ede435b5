"""Deep RL with and without discovered options: ``python -m experiments.deep``."""
