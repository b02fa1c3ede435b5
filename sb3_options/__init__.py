"""Options for Stable-Baselines3 agents, discovered while they train by differentiable diverse density."""
