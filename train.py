"""Train an agent that discovers its own options, or evaluate one: ``python train.py --help``."""

from sb3_options.__main__ import main

if __name__ == "__main__":
    main("train.py", default=())
