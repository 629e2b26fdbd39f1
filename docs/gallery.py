"""Makes the pictures of gallery.md again: runs its blocks in a folder of their own, and keeps what they wrote, small.

`python docs/gallery.py` for all of them; `python docs/gallery.py dawn sea` keeps only these (and runs what they need).
"""

import re
import shutil
import subprocess
import sys
import tempfile
from contextlib import chdir
from pathlib import Path

from PIL import Image, ImageSequence

from jaxhf.xla.machine import available_bytes

DOCS = Path(__file__).resolve().parent
MOST = 250_000  # bytes of one picture
BLOCKS = re.compile(  # as the tests read them: a condition and a reason to leave the block out, its language, title and lines
    r'(?:<!-- skip: next if\((.*), reason="(.*)"\) -->\n\n)?^```(\w+)(?: title="([^"\n]*)")?\n((?:.*\n)*?)```', re.MULTILINE
)


def keep(path: Path) -> None:
    """A film in as many colours, a picture as a JPEG as good, as make it small enough."""
    target = DOCS / "images" / "gallery" / path.name
    if path.suffix == ".gif":
        frames = [frame.convert("RGB") for frame in ImageSequence.Iterator(Image.open(path))]
        wait = Image.open(path).info["duration"]
        for colours in (128, 64, 32, 16):
            few = [frame.quantize(colours, dither=Image.Dither.NONE) for frame in frames]
            few[0].save(target, save_all=True, append_images=few[1:], duration=wait, loop=0, optimize=True)
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
    namespace: dict[str, object] = {"available_bytes": available_bytes}
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
