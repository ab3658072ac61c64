"""The site: pages of this folder, notebooks as they are kept, and docstrings (decision 0046).

./run sphinx-build -W --keep-going -q docs site
"""

import json

from docutils import nodes
from myst_parser.parsers.sphinx_ import MystParser
from pygments.lexers.special import TextLexer
from sphinx.application import Sphinx

import pipeline

project = "Physics pipeline"
version = release = pipeline.__version__
extensions = ["myst_parser", "sphinx.ext.autodoc", "sphinx.ext.napoleon"]
html_theme = "furo"
html_title = project
html_show_sourcelink = False
html_show_copyright = False
highlight_language = "text"
default_role = "code"
autodoc_type_aliases = {"ArrayLike": "ArrayLike", "Force": "Force"}
myst_heading_anchors = 4
exclude_patterns = ["**/results"]


class NotebookParser(MystParser):
    """Notebooks: cells of text as they are, code, and what is kept of its outputs."""

    supported = ("notebook",)

    def parse(self, inputstring: str, document: nodes.document) -> None:
        """Parse the Markdown that says the same."""
        super().parse("\n\n".join(part for cell in json.loads(inputstring)["cells"] for part in _parts(cell)), document)


def _parts(cell):
    source = "".join(cell["source"])
    if cell["cell_type"] == "markdown":
        yield source
        return
    yield f"```python\n{source}\n```"
    for output in cell["outputs"]:
        if output["output_type"] == "stream":
            yield f"```text\n{''.join(output['text'])}```"
        else:
            yield f'<p><img alt="plot" src="data:image/png;base64,{output["data"]["image/png"]}"></p>'


def _below_decisions(_app: Sphinx, name: str, source: list[str]) -> None:
    if name == "decisions/README":
        source[0] += "\n```{toctree}\n:hidden:\n:glob:\n\n0*\n```\n"


def setup(app: Sphinx) -> None:
    """Read notebooks, too, and put each decision below their list."""
    app.connect("source-read", _below_decisions)
    app.add_lexer("mermaid", TextLexer)  # a diagram is shown as its text: drawing it needs a script from elsewhere
    app.add_source_suffix(".ipynb", "notebook")
    app.add_source_parser(NotebookParser)
