"""The command line as tests call it: the arguments in, exit status and what is printed out."""

from collections.abc import Callable

import pytest

from workbench.cli import main

Said = tuple[int, str, str]
"""Exit status, stdout, stderr."""
Shell = Callable[..., Said]


def caller(capfd: pytest.CaptureFixture[str]) -> Shell:
    """What runs a command line whose arguments may be of any type."""

    def call(*arguments: object) -> Said:
        status = main([str(argument) for argument in arguments])
        out, err = capfd.readouterr()
        return status, out, err

    return call
