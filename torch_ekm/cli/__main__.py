"""``python -m torch_ekm.cli``: as ``torch-ekm``."""

from . import main

if __name__ == "__main__":
    main()
