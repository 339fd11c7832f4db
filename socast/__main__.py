"""Run the command line: `python -m socast`."""

from socast.tools.cli import main

if __name__ == "__main__":
    main()
