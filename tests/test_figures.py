"""A figure in prose comes from where it was measured: a file of docs/measurements, a command, or a hand, as the page says."""

import re
import runpy
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
DOCS = ROOT / "docs"
PAGES = [ROOT / "README.md", ROOT / "CHANGELOG.md", *sorted(DOCS.rglob("*.md"))]
NAMES = [str(page.relative_to(ROOT)) for page in PAGES]
MACROS = runpy.run_path(str(DOCS / "macros.py"))
SOURCED = {name: MACROS[name] for name in ("figure", "span", "count")}

# What was measured: a number with a unit of time, memory or speed, with % or "times", or after the name of an error; a part of
# the time, in words. Degrees, metres and pixels are mostly what somebody chose, and are not looked at.
NUMBER = r"(?<![\w.])\d[\d.,]*(?: 000)?"
UNIT = r"(?:ms|s|ns|µs|min|minutes?|seconds?|hours?|bytes?|kB|MB|GB|MiB|GiB|%|times|million (?:rays|steps))(?![\w²])"
SHARE = "half|twice|(?:third|quarter|fifth|sixth|eighth|tenth|twelfth)s?"
PART = rf"\b(?:{SHARE})\b[^.;:]{{0,40}}\b(?:time|longer|long|faster|fast|memory)\b"
ERROR = rf"\b(?:cosine|error|ratio|χ²|RMSE|correlation)s?(?: \w+){{0,3}} {NUMBER}"
FIGURE = re.compile(rf"{NUMBER}\s{UNIT}|{NUMBER}%|{PART}|{ERROR}")

# What says where the numbers beside it come from: a hand, a command that anyone can run, the lines of the page itself.
SOURCE = re.compile(r"\bby hand\b|benchmarks/\w+\.py|tests/[\w/]+\.py|pytest |lines above print", re.IGNORECASE)
WHOLE = {unit: re.compile(rf"figures of this {unit} are by hand", re.IGNORECASE) for unit in ("page", "section")}

# What looks like a figure and was chosen, or follows from a definition, and why.
CHOSEN = {
    "docs/coming-from/blender.md": {"f / 36 times the longer side": "what a focal length means"},
    "docs/concepts/recovery.md": {"then twice as many each time": "how stages are made"},
    "docs/concepts/shading.md": {"within a cosine of 0.01": "where a corner is rounded off"},
    "docs/gallery.md": {"with 1 % of noise": "what was added to the pictures"},
    "docs/guides/devices.md": {"for 60 s is taken for dead": "XLA's limit", "at most 500 MB": "what the folder may hold"},
    "docs/guides/files.md": {"255 times the value": "what a byte means"},
    "docs/guides/fitting.md": {"then χ² is near 1": "what an estimate of the noise leads to by itself"},
    "docs/measurements/settings.md": {"**99.9 %**": "the name of a column"},
    "docs/tutorials/photographs.md": {"Is χ² near 1?": "a question"},
    "docs/reference/faq.md": {"over 30 km are 1 %": "a division", "5 % wrong": "the cosine of a latitude"},
    "docs/reference/glossary.md": {"68 %": "of the normal distribution"},
    "docs/tutorials/robots.md": {"an error of 2 cm": "the example's sensor"},
}


# As README has them, which nothing builds: a figure as it is written out, and beside it, as a comment, the macro that makes it.
WRITTEN = re.compile(rf"({NUMBER}(?:\s+to\s+{NUMBER})?)<!-- (\w+\(.*?\)) -->", re.DOTALL)


def evaluated(call: str) -> str:
    return eval(call, {"__builtins__": {}}, dict(SOURCED))


def paragraphs(text: str) -> list[str]:
    """Of a section, with the items of its lists one by one; a table belongs to what stands before it."""
    parts: list[str] = []
    for part in re.split(r"\n\s*\n|\n(?=- |\d\. )", text):
        if part.lstrip().startswith("|") and parts:
            parts[-1] += "\n" + part
        else:
            parts.append(part)
    return parts


def unsourced(text: str, chosen: dict[str, str]) -> list[str]:
    """The figures of a page that nobody answers for."""
    text = re.sub(r"^```.*?^```$", "", text, flags=re.MULTILINE | re.DOTALL)
    if WHOLE["page"].search(" ".join(text.split())):
        return []
    found = []
    for section in re.split(r"^#+ .*$", text, flags=re.MULTILINE):
        if WHOLE["section"].search(" ".join(section.split())):
            continue
        for paragraph in paragraphs(section):
            if SOURCE.search(" ".join(paragraph.split())):
                continue
            said = re.sub(r"\{\{.*?\}\}|`[^`\n]*`", "…", paragraph, flags=re.DOTALL)
            said = " ".join(re.sub(r"<!--.*?-->", "", WRITTEN.sub("…", said), flags=re.DOTALL).split())
            for words in chosen:
                said = said.replace(words, "…")
            found += [match[0] for match in FIGURE.finditer(said)]
    return found


@pytest.mark.parametrize("name", NAMES)
def test_figures_have_a_source(name):
    chosen = CHOSEN.get(name, {})
    text = (ROOT / name).read_text()
    assert not unsourced(text, chosen)
    assert all(words in " ".join(text.split()) for words in chosen), "no longer there"


@pytest.mark.parametrize("name", NAMES)
def test_figures_are_those_of_the_measurements(name):
    """The site's builder makes them; README and CHANGELOG have them written out, and the macro beside each as a comment."""
    text = (ROOT / name).read_text()
    for call in re.findall(r"\{\{\s*((?:figure|span|count)\(.*?\))\s*\}\}", text, re.DOTALL):
        assert evaluated(call)
    assert len(WRITTEN.findall(text)) == len(re.findall(r"<!-- (?:figure|span|count)\(", text)), "beside no number"
    for said, call in WRITTEN.findall(text):
        assert " ".join(said.split()) == evaluated(call), call
