"""Speed, side by side with peers, on one thread: numpy reads how many when it is imported, which comes after this."""

import os

os.environ["OPENBLAS_NUM_THREADS"] = os.environ["MKL_NUM_THREADS"] = "1"
