"""`python -m facerf_cli` is the same as `facerf`."""

from facerf_cli.main import run

if __name__ == "__main__":
    run()
