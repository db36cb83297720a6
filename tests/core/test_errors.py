"""Faults in words."""

from simbias.core.errors import reason


def test_an_error_of_the_system_names_its_file_if_it_has_one() -> None:
    assert reason(FileNotFoundError(2, "No such file", "x.csv")) == "No such file: x.csv"
    assert reason(OSError(5, "Input/output error")) == "Input/output error"
