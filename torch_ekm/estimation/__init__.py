"""What hand and motions are thought to be: Gaussian estimates, all by one update.

What sensors leave open stands in one table, ``torch_ekm/_noise.py``."""
