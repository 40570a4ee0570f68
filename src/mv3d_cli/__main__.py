"""`python -m mv3d_cli` and the installed `mv3d`."""

from mv3d_cli.cli.app import main

if __name__ == "__main__":
    main()
