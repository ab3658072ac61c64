"""Where the project and the modules that tests share lie, whatever folder a test is in."""

from pathlib import Path

HELPERS = Path(__file__).resolve().parent
PROJECT = HELPERS.parents[1]
