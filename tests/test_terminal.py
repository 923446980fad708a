"""Names and options of a stranger are printed as they are."""

import ast

from asysplat.terminal import make_console, print_table

HOSTILE = "[/b] [red]x :smile: test_sets=[replica]"


def test_names_are_printed_as_they_are(capsys, monkeypatch):
    monkeypatch.setenv("COLUMNS", "200")
    make_console().print(HOSTILE, soft_wrap=True)
    print_table(make_console(), ["", HOSTILE], [[HOSTILE, "1"]], title=HOSTILE)
    assert capsys.readouterr().out.count(HOSTILE) == 4
    make_console(stderr=True).print(HOSTILE)
    assert capsys.readouterr() == ("", f"{HOSTILE}\n")


def test_no_other_console_is_made(repository):
    files = [*repository.glob("*.py"), *repository.glob("asysplat/**/*.py")]
    files += repository.glob("benchmarks/**/*.py")
    calls = [
        f"{file.name}:{node.lineno}"
        for file in files
        for node in ast.walk(ast.parse(file.read_text()))
        if isinstance(node, ast.Call) and ast.unparse(node.func) in ("Console", "rich.print")
    ]
    assert len(calls) == 1 and calls[0].startswith("terminal.py:")
