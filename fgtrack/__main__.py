"""`python -m fgtrack`: the command line."""

from fgtrack.cli.entry import main

if __name__ == "__main__":
    main()
