"""Line numbers of keys: against hand-written texts, and against tomllib's view of generated ones."""

import tomllib
from datetime import date

import tomlkit
from hypothesis import given, settings
from hypothesis import strategies as st

from pipeline.model.positions import locate_keys

KEYS = st.one_of(
    st.from_regex(r"[A-Za-z0-9_-]{1,8}", fullmatch=True),
    st.text(st.characters(codec="utf-8", exclude_categories=["Cs", "Cc"])),
)
SCALARS = st.one_of(
    st.integers(-1000, 1000),
    st.floats(allow_nan=False),
    st.booleans(),
    st.just(date(2020, 2, 29)),
    st.text(st.characters(codec="utf-8", exclude_categories=["Cs"]), max_size=20),
    st.sampled_from(['"', "'''", '"""', "\\", "# no comment", "a = 1", "[table]", "]", "}", ","]),
)
DOCUMENTS = st.dictionaries(
    KEYS,
    st.recursive(
        SCALARS,
        lambda inner: st.lists(inner, max_size=3) | st.dictionaries(KEYS, inner, max_size=3),
        max_leaves=8,
    ),
    max_size=4,
)


def paths_of(value, path=()):
    """Every key and index of a parsed document."""
    if path:
        yield path
    children = value.items() if isinstance(value, dict) else enumerate(value) if isinstance(value, list) else ()
    for key, child in children:
        yield from paths_of(child, (*path, key))


@settings(max_examples=150, deadline=None)
@given(DOCUMENTS)
def test_every_key_that_tomllib_reads_has_a_line_and_no_other(document):
    text = tomlkit.dumps(document)
    parsed = tomllib.loads(text)
    lines = locate_keys(text)
    assert set(lines) == set(paths_of(parsed))
    assert all(1 <= line <= text.count("\n") + 1 for line in lines.values())


def test_lines_of_tables_arrays_and_strings_over_several_lines():
    text = '''\
# comment with [brackets] and = signs
top = """
a = 1
[not.a.table]
"""            # closing quotes
dotted . "quoted key" . 'literal' = 7

[[fluid]]
name = "a"
  [[fluid.block]]
  shape = { type = "box", size = [1,   # inner comment, with ]
                    2] }
  [[fluid.block]]
  position = [0, 0, 1]
[[fluid]]
block = [ { p = 1 },
          { p = 2 } ]
[domain]
min = \'\'\'x\'\'\'
'''
    lines = locate_keys(text)
    assert set(lines) == set(paths_of(tomllib.loads(text)))
    assert lines["top",] == 2
    assert lines["dotted", "quoted key", "literal"] == 6
    assert lines["fluid", 0] == 8
    assert lines["fluid", 0, "block", 0, "shape", "size"] == 11
    assert lines["fluid", 0, "block", 0, "shape", "size", 1] == 12
    assert lines["fluid", 0, "block", 1] == 13
    assert lines["fluid", 0, "block", 1, "position"] == 14
    assert lines["fluid", 1] == 15
    assert lines["fluid", 1, "block", 1, "p"] == 17
    assert lines["domain", "min"] == 19


def test_escapes_in_quoted_keys_are_decoded():
    text = '"caf\\u00e9\\n\\"" = 1\n'
    assert set(locate_keys(text)) == {('café\n"',)} == {(key,) for key in tomllib.loads(text)}
