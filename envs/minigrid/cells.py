"""How many values the three numbers of a cell take, and how long its one-hot code is."""

OBJECTS, COLOURS, STATES = 11, 6, 4
"""Objects, colours, and states of doors or directions of agents."""

DEPTH = OBJECTS + COLOURS + STATES
"""Numbers of the code of a cell."""
