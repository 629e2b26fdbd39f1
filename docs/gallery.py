"""Makes the pictures of gallery.md again: runs its blocks in a folder of their own, and keeps what they wrote, small.

`python docs/gallery.py` for all of them; `python docs/gallery.py dawn sea` keeps only these (and runs what they need).
"""

import itertools
import re
import shutil
import subprocess
import sys
import tempfile
from contextlib import chdir
from importlib.util import find_spec
from pathlib import Path

from PIL import Image, ImageSequence

from jaxhf.xla.machine import available_bytes

DOCS = Path(__file__).resolve().parent
MOST = 250_000  # bytes of one picture
SECONDS = 6  # of a film, at least
BLOCKS = re.compile(  # as the tests read them: a condition and a reason to leave the block out, its language, title and lines
    r'(?:<!-- skip: next if\((.*), reason="(.*)"\) -->\n\n)?^```(\w+)(?: title="([^"\n]*)")?\n((?:.*\n)*?)```', re.MULTILINE
)


def keep(path: Path) -> None:
    """A film as a WebP of six seconds or more with as many frames, a picture as a JPEG, as good as makes it small enough."""
    target = DOCS / "images" / "gallery" / path.name
    if path.suffix == ".gif":
        target, film = target.with_suffix(".webp"), Image.open(path)
        frames, waits = zip(*((one.convert("RGB"), one.info["duration"]) for one in ImageSequence.Iterator(film)), strict=True)
        slower = max(1, SECONDS * 1000 / sum(waits))
        for every, quality in itertools.product((1, 2, 3, 4, 6), (85, 70, 55, 45)):
            first, *others = frames[::every]
            wait = [round(slower * sum(waits[k : k + every])) for k in range(0, len(waits), every)]
            first.save(target, save_all=True, append_images=others, duration=wait, loop=0, quality=quality, method=4)
            if target.stat().st_size <= MOST:
                break
    else:
        for quality in range(90, 10, -5):
            Image.open(path).convert("RGB").save(target.with_suffix(".jpg"), quality=quality, optimize=True, progressive=True)
            if target.with_suffix(".jpg").stat().st_size <= MOST:
                break


def main(wanted: list[str]) -> None:
    page = (DOCS / "gallery.md").read_text()
    shell = {"check": True, "shell": True}
    namespace: dict[str, object] = {"available_bytes": available_bytes, "installed": lambda name: find_spec(name) is not None}
    with tempfile.TemporaryDirectory() as folder, chdir(folder):
        shutil.copytree(DOCS.parent / "scenes", "scenes")
        for section in re.split(r"^## ", page, flags=re.MULTILINE):
            name = re.search(r"images/gallery/(\w+)\.", section)
            if wanted and name and name[1] not in wanted:
                continue
            for condition, reason, language, title, block in BLOCKS.findall(section):
                if condition and eval(condition, namespace):
                    print(f"{name[1] if name else ''}: left as it is, {reason}")
                elif language == "sh":
                    subprocess.run(block, **shell)
                elif language == "toml":
                    Path(title).write_text(block)
                else:
                    exec(block, namespace)
            for path in Path().glob(f"{name[1]}.*") if name else ():
                if path.suffix in (".png", ".gif"):
                    print(path)
                    keep(path)


if __name__ == "__main__":
    main(sys.argv[1:])
