"""What others wrote is shown in MLflow as they wrote it."""

import html
import io
import re
from dataclasses import replace

from rich.console import Console

from simbias.core import markdown
from simbias.terminal.trial import TrialConsole
from simbias.trial.study import Study

BAD = [
    "<img src=x onerror=alert(1)>",
    "<script>alert(1)</script>",
    "a | b",
    "**bold** and `code`",
    "[here](javascript:alert(1))",
    "![see](http://far/pixel.png)",
    "[here][there]",
    "a\\|b\nand\tmore",
    "&lt;b&gt; &amp;",
]


def test_words_of_others_are_text() -> None:
    """As they are, as code, and as a label, which breaks no table."""
    for words in BAD:
        shown = markdown.text(words)
        assert not set("<>|`*\\\n\t") & set(shown), words
        assert not re.search(r"\][(\[]", shown), words
        assert html.unescape(shown) == " ".join(words.split())
        code = markdown.code(words)
        assert (code.count("`"), code[0], code[-1]) == (2, "`", "`")
        assert "\n" not in code
        head, _, row, *rest = markdown.table([words, "b"], [[words, "1"]]).splitlines()
        assert rest == []
        assert head.count("|") == row.count("|") == 3
        assert "<" not in head + row
    for words in ("0.1/1e-06/0.001", "20% error", "6.4 [5.1, 7.8]", "sparse_gp", "the paper's", "d = 1/6"):
        assert markdown.text(words) == words


def test_words_of_others_are_no_style_in_a_terminal(study: Study) -> None:
    out = io.StringIO()
    choices = {**study.choices, "bias": "[/bold] [red]\x1b[2J"}
    odd = replace(study, composition=replace(study.composition, choices=choices))
    with TrialConsole(odd, Console(file=out)):
        pass
    assert "bias [/bold] [red]\\x1b[2J, optimizer" in out.getvalue()
