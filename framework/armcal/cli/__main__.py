"""``python -m armcal.cli``: the same as ``armcal``."""

from armcal.cli.main import main

if __name__ == "__main__":
    main()
