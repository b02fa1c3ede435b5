"""Numbers of values of a cell's three channels, and the length of its one-hot code."""

OBJECTS, COLOURS, STATES = 11, 6, 4  # states of doors, or directions of agents
DEPTH = OBJECTS + COLOURS + STATES
