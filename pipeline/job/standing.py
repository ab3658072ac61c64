"""The part of an invalid job that stands: what is left without the keys and tables that were refused.

Validation ends at the first layer of faults: a job with a misspelt key is never looked at as a scene. Without what was
refused it can be, so that a user hears of all faults at once. What may merely follow from a fault is not told.
"""

import json
from collections.abc import Mapping
from itertools import count, islice
from typing import Any

from pydantic import ValidationError

from pipeline.job.messages import explain
from pipeline.kinds.table import KINDS, job_type
from pipeline.model.job import Job
from pipeline.model.positions import KeyPath
from pipeline.model.problems import Problem


class StandingPart:
    """A document without what was refused, its problems so far, and `job`, the rest of it if that is one.

    Lists keep their order; `written` gives the place in the file of a place in the rest.
    """

    def __init__(self, document: Mapping[str, Any]) -> None:
        self.problems: list[Problem] = []
        self.job: Job | None = None
        self._document = document
        self._refused: set[KeyPath] = set()
        self._validate()

    def _validate(self) -> None:
        """Validate strictly and take out what is refused, until the rest is a job or nothing of it is left."""
        while self.job is None:
            rest = self._without(self._document, ())
            try:
                self.job = job_type().model_validate(_with_tuples(rest), strict=True)
            except ValidationError as error:
                found = [Problem(self.written(each.path), each.message) for each in explain(error, rest)]
                self.problems += [each for each in found if not self._may_follow(each)]
                if any(not each.path for each in found):
                    return
                self._refused |= {each.path for each in found}

    def _without(self, value: Any, path: KeyPath) -> Any:
        if isinstance(value, Mapping):
            places = {key: (*path, key) for key in value}
            return {key: self._without(value[key], at) for key, at in places.items() if at not in self._refused}
        if isinstance(value, list):
            elements = [(child, (*path, index)) for index, child in enumerate(value)]
            return [self._without(child, at) for child, at in elements if at not in self._refused]
        return value

    def written(self, path: KeyPath) -> KeyPath:
        """The place in the document of a place in the rest of it."""
        place: KeyPath = ()
        for part in path:
            place = (*place, self._written_index(place, part) if isinstance(part, int) else part)
        return place

    def _written_index(self, place: KeyPath, index: int) -> int:
        kept = (each for each in count() if (*place, each) not in self._refused)
        return next(islice(kept, index, None))

    def _may_follow(self, problem: Problem) -> bool:
        """Whether a problem may be there only because a part of the same table, or a body, is missing from the rest."""
        return any(path[: len(problem.path)] == problem.path for path in self._refused) or self._names_touched(problem)

    def may_follow(self, problem: Problem) -> bool:
        """Whether a problem of the scene, at a written place, may be there only because of what was refused."""
        touched = self._touched()
        if not problem.path or ("domain",) in touched:
            return bool(touched)
        return any(problem.path[: len(path)] == path for path in touched) or self._names_touched(problem)

    def _touched(self) -> set[KeyPath]:
        """Bodies and tables of the first level of which something was refused."""
        return {path[:2] if path[0] in KINDS else path[:1] for path in self._refused}

    def _names_touched(self, problem: Problem) -> bool:
        bodies = [self._document[str(path[0])][path[1]] for path in self._touched() if len(path) == 2]
        names = [body.get("name") for body in bodies if isinstance(body, Mapping)]
        return any(json.dumps(name, ensure_ascii=False) in problem.message for name in names)


def _with_tuples(value: Any) -> Any:
    """The document with tuples for lists: the models hold tuples, and strict validation converts nothing."""
    if isinstance(value, Mapping):
        return {key: _with_tuples(child) for key, child in value.items()}
    return tuple(_with_tuples(child) for child in value) if isinstance(value, list) else value
