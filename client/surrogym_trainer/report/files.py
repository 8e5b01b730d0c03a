"""The report as a file: HTML, or PDF if Chromium is installed."""

from __future__ import annotations

import shutil
import subprocess
from pathlib import Path
from tempfile import TemporaryDirectory

from surrogym_client.errors import SurrogymClientError

BROWSERS = ("chromium", "chromium-browser", "google-chrome")
SECONDS = 120.0


class NoPdf(SurrogymClientError):
    """No PDF could be made."""


def write(out: Path, page: str) -> int:
    """Write an HTML page to the file ``out``, as HTML or PDF by the file's ending, and return the file's size in bytes.

    Raises:
        NoPdf: Chromium is not installed, or it failed; nothing was written.
    """
    content = as_pdf(page) if out.suffix.lower() == ".pdf" else page.encode()
    return out.write_bytes(content)


def as_pdf(page: str) -> bytes:
    """Return a page as PDF, printed by a headless Chromium. Raises ``NoPdf`` if Chromium is not installed or fails."""
    browser = next((path for name in BROWSERS if (path := shutil.which(name))), None)
    if browser is None:
        raise NoPdf("a PDF needs Chromium, which is not installed: install it, or write HTML with --out report.html")
    with TemporaryDirectory() as folder:
        html, pdf = Path(folder) / "report.html", Path(folder) / "report.pdf"
        html.write_text(page, encoding="utf-8")
        options = (
            "--headless",
            "--no-sandbox",
            "--disable-gpu",
            "--no-pdf-header-footer",
            f"--user-data-dir={folder}/own",
        )
        command = [browser, *options, f"--print-to-pdf={pdf}", html.as_uri()]
        try:
            subprocess.run(command, check=True, capture_output=True, timeout=SECONDS)
            return pdf.read_bytes()
        except (OSError, subprocess.SubprocessError) as error:
            raise NoPdf(f"no PDF was made: {browser} failed: {error}; print the HTML from a browser") from error
