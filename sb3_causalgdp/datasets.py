"""Make offline datasets from the command line: ``python -m sb3_causalgdp.datasets make --help``."""

from sb3_causalgdp.offline.make import main

if __name__ == "__main__":
    main()
