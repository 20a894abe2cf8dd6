"""``python -m torch_ekm.cli``: as ``torch-ekm``."""

from . import main

main()
