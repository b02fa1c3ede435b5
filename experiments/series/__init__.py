"""Does a series of growing tasks, with options carried on, lead to a task that is too far away to be learned alone?"""
