"""Pictures of the terminal: runs a command in a terminal of 120 columns and draws what it left on the screen.

python docs/pictures/terminal.py FILE.png COMMAND...        (needs Linux, rich and Chromium)
"""

import fcntl
import os
import pty
import re
import shlex
import struct
import subprocess
import sys
import tempfile
import termios
from pathlib import Path

from PIL import Image
from rich.console import Console
from rich.text import Text

COLUMNS = 120
PAGE = """<!doctype html><meta charset="utf-8"><style>
body {{ margin: 0; background: {background}; color: {foreground} }}
pre {{ margin: 14px 18px; font: 13px/17px "DejaVu Sans Mono", monospace }} .prompt {{ color: #116329 }} {stylesheet}
</style><pre><span class="prompt">$</span> COMMAND
{code}</pre>"""


def run_in_terminal(words: list[str]) -> str:
    """What a command printed, both streams, as a terminal of COLUMNS columns received it."""
    ours, theirs = pty.openpty()
    fcntl.ioctl(theirs, termios.TIOCSWINSZ, struct.pack("HHHH", 50, COLUMNS, 0, 0))
    process = subprocess.Popen(words, stdin=theirs, stdout=theirs, stderr=theirs, env=os.environ | {"TERM": "xterm"})
    os.close(theirs)
    chunks = []
    while True:
        try:
            chunks.append(os.read(ours, 65536))
        except OSError:  # the other side is closed
            break
    if process.wait():
        raise SystemExit(f"{shlex.join(words)} ended with {process.returncode}")
    return b"".join(chunks).decode()


def left_on_screen(text: str) -> str:
    """Lines as they stand at their end. The progress lines stay; a terminal takes them away when they are done."""
    lines = [line.rstrip("\r").rpartition("\r")[2] for line in text.split("\n")]
    return "\n".join(re.sub(r"\x1b\[\d*[ABCDGJK]", "", line).rstrip() for line in lines).rstrip()


def draw(command: str, printed: str, path: Path) -> None:
    """A picture of a command and its output, by headless Chromium."""
    console = Console(record=True, width=COLUMNS, file=open(os.devnull, "w"), force_terminal=True)
    lines = Text.from_ansi(printed).wrap(console, COLUMNS)
    console.print(*lines, sep="\n")
    page = console.export_html(code_format=PAGE).replace("COMMAND", command, 1)
    height = 28 + 17 * (len(lines) + 1)
    with tempfile.TemporaryDirectory() as folder:
        (Path(folder) / "page.html").write_text(page)
        size = f"--window-size={36 + 8 * COLUMNS},{height}"
        flags = ["--headless", "--no-sandbox", "--hide-scrollbars", "--disable-gpu", size, f"--screenshot={path}"]
        subprocess.run(["chromium", *flags, f"file://{folder}/page.html"], check=True, capture_output=True, timeout=120)
    with Image.open(path) as picture:
        small = picture.convert("RGB").quantize(32)  # the colours of text
    small.save(path, optimize=True)


if __name__ == "__main__":
    draw(shlex.join(sys.argv[2:]), left_on_screen(run_in_terminal(sys.argv[2:])), Path(sys.argv[1]).absolute())
