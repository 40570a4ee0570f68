"""The command itself: quick, quiet, one line for an error and one for what to do."""

from __future__ import annotations

import json
import os
import re
import subprocess
import sys
import time
from dataclasses import fields
from typing import Literal, get_args, get_origin

import pytest

from mv3d_cli import __version__
from mv3d_cli.steps import generate, render, train
from mv3d_cli.steps.settings import Doc, settings_of

WIDE = {"COLUMNS": "300", "TERMINAL_WIDTH": "300"}


def completed(mv3d, line: str) -> list[str]:
    """What the shell is offered at the end of a line."""
    word = str(len(line.split(" ")) - 1)
    return mv3d(env={"_MV3D_COMPLETE": "complete_bash", "COMP_WORDS": line, "COMP_CWORD": word}).stdout.split()


def test_help_answers_at_once(mv3d):
    times = []
    for _ in range(6):
        start = time.perf_counter()
        assert mv3d("--help").code == 0
        times.append(time.perf_counter() - start)
    assert min(times) < 0.3


@pytest.mark.parametrize("words", [["--help"], ["render", "--help"], ["train", "--help"], ["generate", "--help"]])
def test_help_imports_no_numbers(words):
    code = f"""
import json, sys
sys.argv = ["mv3d", *{words}]
from mv3d_cli.__main__ import main
try: main()
except SystemExit as end: assert not end.code, end.code
heavy = {{"torch", "warp", "numpy", "cv2", "trimesh", "scipy"}}
print(json.dumps(sorted(heavy & set(sys.modules))), file=sys.stderr)
"""
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert json.loads(done.stderr.splitlines()[-1]) == []


def test_help_lists_the_commands(mv3d):
    ran = mv3d("--help")
    assert (ran.code, ran.stderr) == (0, "")
    assert all(command in ran.stdout for command in ("render", "train", "generate", "cache"))


def test_without_arguments_it_helps(mv3d):
    ran = mv3d()
    assert (ran.code, ran.stdout) == (0, mv3d("--help").stdout)


def test_version(mv3d):
    ran = mv3d("--version")
    assert (ran.code, ran.stdout, ran.stderr) == (0, f"mv3d {__version__}\n", "")


@pytest.mark.parametrize(
    ("words", "problem", "advice"),
    [
        (["rendr"], "rendr", "did you mean render?"),
        (["render", "--sise", "3"], "--sise", "did you mean --size?"),
        (["render", "--size", "big"], "--size", "mv3d render --help"),
        (["render", "--size"], "--size", "--help"),
        (["render", "--lighting", "sun"], "sun", "mv3d render --help"),
        (["render", "--engine", "magic"], "magic", "mv3d render --help"),
        (["--nothing"], "--nothing", "mv3d --help"),
        (["render"], "nothing to render", "--procedural"),
    ],
)
def test_a_command_line_that_does_not_parse(refused, words, problem, advice):
    ran = refused(*words)
    assert problem in ran.stderr.splitlines()[0]
    assert advice in ran.stderr.splitlines()[1]


@pytest.mark.parametrize("env", [{}, {"NO_COLOR": "1"}, {"TERM": "dumb"}])
def test_pipes_get_no_escape_codes(refused, mv3d, env):
    assert "\x1b" not in refused("rendr", env=env).stderr
    assert "\x1b" not in mv3d("--help", env=env).stdout


@pytest.mark.skipif(os.name == "nt", reason="needs a pseudo-terminal")
@pytest.mark.parametrize(("env", "colour"), [({}, True), ({"NO_COLOR": "1"}, False)])
def test_a_terminal_gets_colour_unless_told_not_to(env, colour, tmp_path):
    import pty

    leader, follower = pty.openpty()
    command = [sys.executable, "-m", "mv3d_cli", "rendr"]
    clean = {name: value for name, value in os.environ.items() if name != "NO_COLOR"}
    subprocess.run(command, stderr=follower, env=clean | {"TERM": "xterm-256color"} | env)
    os.close(follower)
    said = os.read(leader, 10_000).decode()
    os.close(leader)
    assert "did you mean render?" in said
    assert (re.search(r"\x1b\[[0-9;]*3[0-9]m", said) is not None) == colour


def test_names_are_not_markup(refused):
    name = "[red]a:smile:[/b].glb"
    assert name in refused("render", name).stderr


def test_completion_script(mv3d):
    ran = mv3d("--show-completion", "bash")
    assert ran.code == 0
    assert "_MV3D_COMPLETE=complete_bash" in ran.stdout


@pytest.mark.parametrize(
    ("line", "offered"),
    [
        ("mv3d ren", ["render"]),
        ("mv3d train --pres", ["--preset"]),
        ("mv3d train --stage a", ["autoencoder"]),
        ("mv3d render --lig", ["--lighting"]),
        ("mv3d render --lighting st", ["studio"]),
        ("mv3d cache ver", ["verify"]),
    ],
)
def test_completion(mv3d, line, offered):
    assert completed(mv3d, line) == offered


@pytest.mark.parametrize("words", [["--debug", "render", "none.glb"], ["render", "none.glb", "--debug"]])
def test_debug_shows_the_traceback(mv3d, words):
    ran = mv3d(*words)
    assert (ran.code, ran.stdout) == (1, "")
    assert "Traceback" in ran.stderr
    assert "MissingInput" in ran.stderr


def test_a_fault_of_ours_is_one_line_too(tmp_path):
    code = """
import sys
from mv3d_cli.cli import app
import mv3d_cli.steps.render as step
import mv3d_cli.cli.render as command
def run(*_): raise ZeroDivisionError("oh\\nno")
command.run = run
sys.argv = ["mv3d", "render", "a.glb"]
app.main()
"""
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, cwd=tmp_path)
    assert (done.returncode, done.stdout) == (1, "")
    assert [line.split(":")[0] for line in done.stderr.splitlines()] == ["error", "hint"]
    assert "ZeroDivisionError: oh no" in done.stderr


@pytest.mark.parametrize(
    ("command", "config"), [("render", render.Config), ("train", train.Config), ("generate", generate.Config)]
)
def test_the_options_of_a_command_are_its_settings(mv3d, command, config):
    page = mv3d(command, "--help", env=WIDE).stdout
    options = re.findall(r"^\W*(--[a-z-]+)", page, re.MULTILINE)
    assert options == ["--output", "--json", *(s.option for s in settings_of(config)), "--help"]
    for setting in settings_of(config):
        (line,) = (line for line in page.splitlines() if f" {setting.option} " in line)
        assert setting.mark(Doc).text in line
        default = ",".join(setting.default) if isinstance(setting.default, tuple) else setting.default
        if default not in (None, "") and default is not False:
            assert f"[default: {default}]" in line
        for choice in get_args(setting.kind) if get_origin(setting.kind) is Literal else ():
            assert choice in line
    assert len(fields(config)) == len(settings_of(config))


def test_a_reader_that_leaves_is_no_error(tmp_path):
    done = subprocess.run(
        f"{sys.executable} -m mv3d_cli --help | head -c 1 > /dev/null; exit ${{PIPESTATUS[0]}}",
        shell=True,
        executable="/bin/bash",
        capture_output=True,
        text=True,
        cwd=tmp_path,
    )
    assert "Traceback" not in done.stderr
