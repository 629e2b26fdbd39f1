"""What is handed out is whole: wheel and sdist are built, and the wheel works in a fresh environment."""

import subprocess
import sys
import tarfile
import tomllib
import zipfile
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]


def test_version_and_license_are_named_alike():
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    citation, changes, readme, license = (
        (ROOT / name).read_text() for name in ("CITATION.cff", "CHANGELOG.md", "README.md", "LICENSE")
    )
    assert f"\nversion: {project['version']}\n" in citation
    assert f"## {project['version']}" in changes
    assert project["license"] == "Apache-2.0"
    assert "\nlicense: Apache-2.0\n" in citation
    assert "[Apache-2.0](LICENSE)" in readme
    assert "Version 2.0, January 2004" in license
    assert "the jaxhf authors" in license


@pytest.mark.slow
def test_wheel_and_sdist(tmp_path):
    """Both from a copy of what git knows; 434 and 366 kB in November 2026. Installing needs the index of packages."""
    tracked = subprocess.run(["git", "archive", "HEAD"], cwd=ROOT, capture_output=True, check=True).stdout
    (tmp_path / "source.tar").write_bytes(tracked)
    with tarfile.open(tmp_path / "source.tar") as archive:
        archive.extractall(tmp_path / "source", filter="data")
    subprocess.run([sys.executable, "-m", "build", "--outdir", tmp_path / "dist", tmp_path / "source"], check=True)
    (wheel,), (sdist,) = (tmp_path / "dist").glob("*.whl"), (tmp_path / "dist").glob("*.tar.gz")
    assert wheel.stat().st_size < 450_000
    assert sdist.stat().st_size < 600_000
    modules = {str(path.relative_to(ROOT)) for path in (ROOT / "jaxhf").rglob("*.py*") if "__pycache__" not in path.parts}
    assert modules | {"jaxhf/py.typed"} == {name for name in zipfile.ZipFile(wheel).namelist() if name.startswith("jaxhf/")}
    subprocess.run([sys.executable, "-m", "venv", tmp_path / "fresh"], check=True)
    programs = tmp_path / "fresh" / "bin"
    subprocess.run([programs / "pip", "install", "--quiet", wheel], check=True)
    (tmp_path / "heights.asc").write_text("ncols 3\nnrows 3\nxllcorner 0\nyllcorner 0\ncellsize 1\n0 0 0\n0 1 0\n0 0 0\n")
    for command in ("info heights.asc", "hillshade heights.asc -o shade.png", "view heights.asc -o view.png --size 64x48"):
        subprocess.run([programs / "jaxhf", *command.split()], cwd=tmp_path, check=True)
    assert (tmp_path / "view.png").stat().st_size > 500
