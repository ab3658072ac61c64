"""Commented job files to start from, made of the files in `templates`."""

import re
from pathlib import Path
from string import Template

from pipeline.base.errors import JobFileError
from pipeline.model.job import NAME_PATTERN

TEMPLATES = ("dam-break", "drop", "smoke", "cloth", "sand")
_FOLDER = Path(__file__).with_name("templates")


def starter(name: str, template: str, *, file: str) -> str:
    """The text of a job file that passes every check; the commands that it shows call it `file`."""
    text = (_FOLDER / f"{template}.toml").read_text(encoding="utf-8")
    return Template(text).substitute(name=name, file=file)


def write_starter(target: Path, template: str) -> Path:
    """Write a starter to `target`, `.toml` added where it is missing. The job is named after the file.

    Raises JobFileError: the name is none for a job, the file exists, or it cannot be written.
    """
    path = target if target.suffix == ".toml" else target.with_name(f"{target.name}.toml")
    name = path.stem
    if not re.fullmatch(NAME_PATTERN, name):
        rule = 'a name holds letters, digits, ".", "_" and "-", and begins with a letter or digit'
        raise JobFileError([f'"{name}": {rule}'])
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        with path.open("x", encoding="utf-8") as file:
            file.write(starter(name, template, file=str(path)))
    except FileExistsError:
        raise JobFileError([f"{path}: exists already; choose another name"]) from None
    except OSError as error:
        raise JobFileError([f"{path}: cannot be written: {error.strerror}"]) from None
    return path
