"""Macros of the pages: tables of measurements, notebooks as they were run, settings and commands with their help."""

import csv
import dataclasses
import json
import os
from pathlib import Path
from typing import Any

FOLDER = Path(__file__).parent / "measurements"


def measured(name: str) -> str:
    """A table from measurements/, under the command that makes it: the file's first line, `# command`; then come the names."""
    command, *lines = (FOLDER / f"{name}.csv").read_text().splitlines()
    head, *rows = ([cell.replace("|", "\\|") for cell in row] for row in csv.reader(lines))
    rule = ["--:" if k and rows[0][k][:1].isdigit() else "---" for k in range(len(head))]
    body = "\n".join("| " + " | ".join(row) + " |" for row in (head, rule, *rows))
    return f"`{command.removeprefix('# ')}` ([{name}.csv]({name}.csv))\n\n{body}\n"


def notebook(name: str) -> str:
    """A notebook with what it printed and its pictures; links to pages of docs/ lead to those of the site."""
    parts = []
    for cell in json.loads((FOLDER.parents[1] / "notebooks" / f"{name}.ipynb").read_text())["cells"]:
        text = "".join(cell["source"])
        if cell["cell_type"] == "markdown":
            parts.append(text.replace("](../docs/", "](../").replace(".ipynb)", ".md)"))
            continue
        parts.append(f"```python\n{text}\n```")
        printed = "".join("".join(output.get("text", "")) for output in cell["outputs"])
        pictures = (output.get("data", {}).get("image/png") for output in cell["outputs"])
        parts += [f'<img alt="" src="data:image/png;base64,{"".join(picture).strip()}">' for picture in pictures if picture]
        parts += [f"```text\n{printed.strip()}\n```"] if printed.strip() else []
    return "\n\n".join(parts)


def settings() -> str:
    """The fields of `jaxhf.Settings`: they describe themselves where Python runs, which the API's pages do without."""
    from jaxhf.core.settings import Settings

    lines = []
    for knob in dataclasses.fields(Settings):
        none = f"; None: {knob.metadata['none']}" if "none" in knob.metadata else ""
        lines.append(f"- **`{knob.name}`** (default: `{knob.default!r}`): {knob.metadata['help']}{none}.")
    return "\n".join(lines)


def commands() -> str:
    """What each command's --help says, which its table of options holds."""
    from jaxhf.cli.parser import COMMANDS, parser_of

    os.environ["COLUMNS"] = "88"  # which argparse fills
    return "\n\n".join(f"## {name}\n\n```text\n{parser_of(command).format_help()}```" for name, command in COMMANDS.items())


def define_env(env: Any) -> None:
    """Called by the site's builder."""
    env.macro(measured)
    env.macro(notebook)
    env.macro(settings)
    env.macro(commands)
