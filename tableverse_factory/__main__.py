"""`python -m tableverse_factory`: the command line."""

from tableverse_factory.cli.main import main

if __name__ == "__main__":
    main()
