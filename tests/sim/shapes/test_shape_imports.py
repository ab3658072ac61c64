"""Reading a job must not load the geometry libraries."""

import subprocess
import sys

from places import PROJECT


def test_parameters_load_neither_trimesh_nor_igl():
    code = "import sys, sim.shapes.parameters; print({'trimesh', 'igl', 'scipy'} & set(sys.modules) or 'none')"
    repository = PROJECT
    answer = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True, cwd=repository)
    assert answer.stdout == "none\n"


def test_a_misspelt_name_is_an_attribute_error():
    import sim.shapes

    assert not hasattr(sim.shapes, "build_sold")
