"""Which command and which job is meant: former names, a file in place of a command, names and files of jobs."""

from pathlib import Path

import pytest
from click.testing import CliRunner
from command_line import pipeline

from pipeline.base.errors import JobFileError, PipelineError
from pipeline.cli.arguments import find_job, find_job_file, place
from pipeline.cli.main import FORMER, SECTIONS, main

OUTPUT = Path("renders")


@pytest.fixture
def here(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.chdir(tmp_path)
    return tmp_path


def put(*paths: str) -> None:
    for path in paths:
        Path(path).parent.mkdir(parents=True, exist_ok=True)
        Path(path).write_text('name = "dam"\nframes = 1\n')


# --- commands ---


@pytest.mark.parametrize("width", [80, 120])
def test_help_shows_every_command_in_its_section_with_its_whole_summary_on_a_line(width: int) -> None:
    told = CliRunner().invoke(main, ["--help"], terminal_width=width).output
    assert "..." not in told.partition("Options:")[2]
    for heading, commands in SECTIONS.items():
        assert f"{heading}:\n" in told
        for command in commands:
            assert f"  {command.name:<9}  {command.get_short_help_str(limit=1000)}\n" in told, command.name
    assert set(main.commands) == {each.name for commands in SECTIONS.values() for each in commands}


@pytest.mark.parametrize("former", FORMER)
def test_a_former_command_says_what_to_type_instead_and_that_exists(former: str) -> None:
    told = pipeline(former, "dam")
    assert told.exit_code == 2
    instead = told.stderr.strip().rpartition("is now: pipeline ")[2].split()
    options = {option for parameter in main.commands[instead[0]].params for option in parameter.opts}
    assert {word for word in instead if word.startswith("--")} <= options
    assert ("dam" in instead) == ("my-film" in FORMER[former])


def test_a_job_file_in_place_of_a_command_is_taken_for_a_submission(here: Path) -> None:
    put("dam.toml")
    for word in ("dam.toml", "dam", "gone.toml"):
        told = pipeline(word)
        assert told.exit_code == 2
        assert f"did you mean: pipeline submit {word}" in told.stderr


@pytest.mark.parametrize(
    ("typed", "meant"), [("stats", "pipeline status"), ("retri", "pipeline rerun --failed"), ("xyzzy", "--help")]
)
def test_an_unknown_command_suggests_the_nearest(here: Path, typed: str, meant: str) -> None:
    told = pipeline(typed)
    assert (told.exit_code, meant in told.stderr) == (2, True)


# --- jobs ---


def test_a_job_file_is_found_by_its_path_its_name_its_folder_and_as_that_of_a_submitted_job(here: Path) -> None:
    put("dam.toml", "films/duck.toml", "moved/job.toml", "renders/fog/job.toml")
    assert find_job_file("dam", OUTPUT) == find_job_file("dam.toml", OUTPUT) == Path("dam.toml")
    assert find_job_file("films/duck", OUTPUT) == Path("films/duck.toml")
    assert find_job_file("moved", OUTPUT) == find_job_file("moved/", OUTPUT) == Path("moved/job.toml")
    assert find_job_file("fog", OUTPUT) == Path("renders/fog/job.toml")
    put("renders/dam/job.toml")  # submitting it again is about the file that one writes
    assert find_job_file("dam", OUTPUT) == Path("dam.toml")


def test_a_job_file_that_is_there_twice_or_not_at_all_is_told(here: Path) -> None:
    put("dam.toml", "dam/job.toml")
    with pytest.raises(JobFileError, match=r"dam.toml or dam/job.toml"):
        find_job_file("dam", OUTPUT)
    with pytest.raises(JobFileError, match=r'neither .*dma.toml nor .*"dma" in renders; did you mean "dam.toml"'):
        find_job_file("dma", OUTPUT)
    assert pipeline("check", "dma").exit_code == 2


def test_a_submitted_job_is_found_by_its_name_its_folder_and_its_file(here: Path) -> None:
    put("film.toml", "renders/dam/job.toml", "elsewhere/fog/job.toml")
    for word in ("dam", "renders/dam", "film.toml", "film", "dam.toml"):  # the name in film.toml is "dam"
        assert find_job(word, OUTPUT).root == Path("renders/dam"), word
    assert find_job("elsewhere/fog", OUTPUT).root == Path("elsewhere/fog")
    assert find_job("fog", Path("elsewhere")).root == Path("elsewhere/fog")


def test_a_submitted_job_that_is_there_twice_or_not_at_all_is_told(here: Path) -> None:
    put("dam/job.toml", "renders/dam/job.toml", "duck.toml")
    with pytest.raises(PipelineError, match=r"\./dam or renders/dam"):
        find_job("dam", OUTPUT)
    assert find_job("./dam", OUTPUT).root == Path("dam")
    with pytest.raises(PipelineError, match=r'renders/dm; did you mean "dam"'):
        find_job("dm", OUTPUT)
    with pytest.raises(PipelineError, match=r"pipeline submit duck.toml"):
        Path("duck.toml").write_text('name = "duck"\nframes = 1\n')
        find_job("duck", OUTPUT)


def test_commands_about_the_queue_and_about_files_mean_the_same_folder(
    here: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    put("renders/dam/job.toml")
    queue, name = place("dam", OUTPUT)
    assert queue.layout(name).root == find_job("dam", OUTPUT).root.absolute() == here / "renders" / "dam"
    monkeypatch.chdir(here / "renders" / "dam")
    assert place(".", OUTPUT)[1] == "dam"
