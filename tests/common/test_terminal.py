"""Streams, variables, home folders and locales that are odd or missing; divergence."""

import io
import os
import shlex
import subprocess
import sys

import numpy as np
import pytest

from bcrl.common import files, terminal
from bcrl.common.divergence import diverging


def test_a_user_folder_is_absolute_or_at_home(tmp_path, monkeypatch):
    monkeypatch.setenv("HOME", str(tmp_path))
    for value, name in (("~/mine", "mine"), ("relative", ".config"), ("", ".config")):
        monkeypatch.setenv("XDG_CONFIG_HOME", value)
        found = files.user_folder("XDG_CONFIG_HOME", ".config")
        assert found == tmp_path / name


@pytest.mark.parametrize("value", ["", "0", "-1", "2(x3)", "1.5"])
def test_a_variable_that_is_no_number_is_ignored(value, monkeypatch):
    monkeypatch.setenv("NUMBA_NUM_THREADS", value)
    terminal.ready()
    assert "NUMBA_NUM_THREADS" not in os.environ


def test_an_ascii_terminal_gets_escapes(monkeypatch):
    out = io.TextIOWrapper(io.BytesIO(), encoding="ascii")
    monkeypatch.setattr(sys, "stdout", out)
    terminal.ready()
    terminal.show("ϱ – 1")
    assert out.buffer.getvalue() == b"\\u03f1 \\u2013 1\n"


@pytest.mark.parametrize("closed", ["<&- >&- 2>&-", ">&-", "2>&-"])
def test_closed_streams_take_no_file(closed, tmp_path):
    program = (
        "from bcrl.common.terminal import ready, say, show; ready();"
        "import subprocess, sys;"
        "file = open('result', 'w'); show('shown'); say('said');"
        "subprocess.run([sys.executable, '-c', 'print(1)']);"
        "file.write(str(file.fileno() > 2)); file.close()"
    )
    line = f"{shlex.join([sys.executable, '-c', program])} {closed}"
    done = subprocess.run(line, shell=True, cwd=tmp_path, capture_output=True)
    assert done.returncode == 0, done.stderr
    assert (tmp_path / "result").read_text() == "True"
    assert (done.stdout == b"") == (">&-" in closed.split())
    assert b"said" not in done.stdout


@pytest.mark.slow
@pytest.mark.parametrize("output", [">/dev/full", ">/dev/null <&- 2>&-"])
def test_a_full_or_closed_output_is_no_traceback(output, tmp_path):
    line = f"{sys.executable} -m bcrl.results.verify --help {output}"
    done = subprocess.run(line, shell=True, cwd=tmp_path, stderr=subprocess.PIPE)
    assert b"Traceback" not in done.stderr and b"No module" not in done.stderr


def test_large_values_diverge():
    steady = np.array([[4.0, 30.0, 2.0]])
    assert diverging({"q_error": steady, "return": steady * 1e6}) == {}
    assert diverging({"q_error": np.array([[4.0, 1300.0]])}) == {"q_error": 1300.0}
    far = {"q_mean": np.array([np.nan, -900.0]), "discounted_return": np.array([-4, 2])}
    assert diverging(far) == {"q_mean": 900.0}
    assert diverging(far | {"discounted_return": np.array([-90.0, 2.0])}) == {}
