"""Run `facerf`, as `python -m facerf_cli`."""

from facerf_cli.main import run

if __name__ == "__main__":
    run()
