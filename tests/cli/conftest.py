"""A command as a user types it, run in this process, where JAX is set up already."""

from collections.abc import Callable

import pytest

from jaxhf.cli.main import main

Run = Callable[..., tuple[int | str | None, str, str]]


@pytest.fixture
def command(monkeypatch, capsys) -> Run:
    """A function of the words after `jaxhf`: it returns the exit code, standard output and standard error."""
    monkeypatch.setattr("jaxhf.cli.limits.set_up_jax", lambda options: None)

    def run(*words: object) -> tuple[int | str | None, str, str]:
        try:
            code = main(list(map(str, words)))
        except SystemExit as ended:
            code = ended.code
        return code, *capsys.readouterr()

    return run
