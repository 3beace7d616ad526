"""Open a report in headless Chromium: pictures to look at, and what the browser complains about.

    python tests/benchmarks/report/look.py REPORT/index.html PICTURES [--axe axe.min.js]

Needs playwright (pip install playwright) and a Chromium that it or the system has. Writes a
picture of the whole page at 1280 and 400 px, light and dark, and page.pdf, and prints console
messages, requests to any host, sideways overflow, and with --axe (the file of the axe-core
project) what the accessibility check finds.
"""

from __future__ import annotations

import argparse
import shutil
from pathlib import Path
from typing import Any

from playwright.sync_api import Browser, Page, sync_playwright

ARGUMENTS = ("--no-sandbox", "--disable-gpu", "--disable-quic", "--disable-background-networking")
WIDTHS, SCHEMES = (1280, 400), ("light", "dark")


def watched(browser: Browser, width: int, scheme: Any) -> Page:
    """Return a page that prints what goes wrong in it."""
    context = browser.new_context(
        viewport={"width": width, "height": 900}, color_scheme=scheme, bypass_csp=True
    )
    page = context.new_page()
    page.on("console", lambda message: print("console:", message.type, message.text))
    page.on("pageerror", lambda error: print("error:", error))
    page.on(
        "request",
        lambda request: (
            None if request.url.startswith(("file:", "data:")) else print("request:", request.url)
        ),
    )
    return page


def main() -> None:
    """Look at a report from all sides."""
    parser = argparse.ArgumentParser()
    parser.add_argument("page", type=Path)
    parser.add_argument("pictures", type=Path)
    parser.add_argument("--axe", type=Path)
    options = parser.parse_args()
    options.pictures.mkdir(exist_ok=True)
    with sync_playwright() as playwright:
        browser = playwright.chromium.launch(
            executable_path=shutil.which("chromium"), args=list(ARGUMENTS)
        )
        for width in WIDTHS:
            for scheme in SCHEMES:
                page = watched(browser, width, scheme)
                page.goto(options.page.resolve().as_uri())
                page.wait_for_timeout(500)
                overflow = page.evaluate("document.documentElement.scrollWidth")
                print(f"{width} px {scheme}: the page is {overflow} px wide")
                page.screenshot(path=options.pictures / f"{width}-{scheme}.png", full_page=True)
                if options.axe:
                    page.evaluate(
                        "document.querySelectorAll('details').forEach(d => d.open = true)"
                    )
                    page.evaluate(options.axe.read_text(encoding="utf-8"))
                    found = page.evaluate("axe.run(document)")
                    print([(item["id"], item["impact"]) for item in found["violations"]])
        page = watched(browser, 1280, "light")
        page.goto(options.page.resolve().as_uri())
        page.pdf(path=options.pictures / "page.pdf", format="A4")
        browser.close()


if __name__ == "__main__":
    main()
