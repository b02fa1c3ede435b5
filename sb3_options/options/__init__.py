"""What an option is, how it is made from trajectories and how it is kept. Pure."""
