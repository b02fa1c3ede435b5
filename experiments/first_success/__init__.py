"""How soon does an agent reach the goal for the first time, when a random walk hardly ever does?"""
