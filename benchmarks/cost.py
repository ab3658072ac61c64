"""What jobs were expected to take, against what they took, by their records, as JSON.

    python -m benchmarks.cost renders [--learnt]

Looks at each job of a folder as if it had never run, on a machine that has learnt nothing (`--learnt`: with what this
one has), and compares that with the attempts and files on record. Stages count as far as they came.
"""

import argparse
import json
from dataclasses import replace
from pathlib import Path

from pipeline.base.layout import JobLayout
from pipeline.base.resources import machine_capacity
from pipeline.job.loading import load_job
from pipeline.model.problems import Findings
from pipeline.queue.cost import Costs, Teacher, expect
from pipeline.queue.disk import size_of
from pipeline.record.reader import ManifestReader
from pipeline.run.plan import assess, plan_job
from pipeline.run.rates import known_rates, measure
from pipeline.stages import STAGES


def compared(layout: JobLayout, *, learnt: bool) -> dict | None:
    """Expected and taken time, disk space and memory of a job's stages; None if it has no frame."""
    job = load_job(layout.job_file)
    rates = known_rates() or measure()
    costs = Costs(rates if learnt else replace(rates, learnt={}), machine_capacity(gpus=1))
    elements = Teacher(job, layout, costs).elements()
    if elements is None:
        return None
    assessments = assess(plan_job(job, layout, STAGES), {}, {}, parameters=lambda _: None)
    expected = {
        each.stage: each for each in expect(job, assessments, size_of(job, Findings(elements=elements)), costs).stages
    }
    with ManifestReader.open_readonly(layout.manifest) as manifest:
        timings = {each.stage: each for each in manifest.stage_timings()}
    stages = {}
    for name, each in expected.items():
        took = timings.get(name)
        if took is None or not took.artifacts:
            continue
        share = took.artifacts / each.files
        stages[name] = {
            "files": took.artifacts,
            "of": each.files,
            "expected_s": round(each.seconds * share, 1),
            "took_s": round(took.seconds, 1),
            "factor": round(each.seconds * share / took.seconds, 2) if took.seconds else None,
            "expected_bytes": round(each.bytes * share),
            "took_bytes": took.bytes,
            "expected_memory": round(each.memory_bytes),
            "peak_memory": took.peak_memory_bytes,
        }
    totals = {key: sum(each[key] for each in stages.values()) for key in ("expected_s", "took_s")}
    return {"stages": stages, **totals, "factor": round(totals["expected_s"] / totals["took_s"], 2)}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folders", type=Path, nargs="+", help="Of jobs, or of a job each.")
    parser.add_argument("--learnt", action="store_true", help="Use what this machine has learnt.")
    options = parser.parse_args()
    found = [
        file for folder in options.folders for file in (*folder.glob("manifest.db"), *folder.glob("*/manifest.db"))
    ]
    results = {file.parent.name: compared(JobLayout(file.parent), learnt=options.learnt) for file in sorted(found)}
    print(json.dumps({name: result for name, result in results.items() if result}, indent=1))


if __name__ == "__main__":
    main()
