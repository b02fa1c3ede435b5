"""Options run in a Gymnasium environment."""
