"""The mathematics of diverse density: bags, concepts, one objective, one search. Pure; knows nothing of agents."""
