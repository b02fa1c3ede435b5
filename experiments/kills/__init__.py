"""A real ``train.py``, killed at random moments and resumed until it is done, beside one that was left alone."""
