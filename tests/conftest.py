import os

# One thread per process, or the workers of pytest-xdist fight for the cores. OpenMP reads this once, when torch is imported.
os.environ["OMP_NUM_THREADS"] = "1"

import torch

torch.set_num_threads(1)
