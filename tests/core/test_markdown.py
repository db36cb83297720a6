"""What others wrote is shown in MLflow as they wrote it."""

from __future__ import annotations

import html
import io
from dataclasses import replace

import pytest
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


@pytest.mark.parametrize("words", BAD)
def test_words_of_others_are_text(words: str) -> None:
    shown = markdown.text(words)
    assert not set("<>|`*\\\n\t") & set(shown)
    assert "](" not in shown
    assert "][" not in shown
    assert html.unescape(shown) == " ".join(words.split())


def test_what_is_no_markup_stays() -> None:
    for words in ("0.1/1e-06/0.001", "20% error", "6.4 [5.1, 7.8]", "sparse_gp", "the paper's", "d = 1/6"):
        assert markdown.text(words) == words


@pytest.mark.parametrize("words", BAD)
def test_code_ends_where_it_should(words: str) -> None:
    shown = markdown.code(words)
    assert shown.count("`") == 2
    assert shown[0] == shown[-1] == "`"
    assert "\n" not in shown


@pytest.mark.parametrize("words", BAD)
def test_a_label_breaks_no_table(words: str) -> None:
    head, _, row, *rest = markdown.table([words, "b"], [[words, "1"]]).splitlines()
    assert rest == []
    assert head.count("|") == row.count("|") == 3
    assert "<" not in head + row


def test_words_of_others_are_no_style_in_a_terminal(study: Study) -> None:
    out = io.StringIO()
    choices = {**study.choices, "bias": "[/bold] [red]\x1b[2J"}
    odd = replace(study, composition=replace(study.composition, choices=choices))
    with TrialConsole(odd, Console(file=out)):
        pass
    assert "bias [/bold] [red]\\x1b[2J, optimizer" in out.getvalue()
