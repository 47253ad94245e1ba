"""The browser that tests look at pages with, where there is one."""

import shutil

import pytest

BROWSER = next(
    filter(None, map(shutil.which, ("chromium", "chromium-browser", "google-chrome", "chrome"))),
    None,
)
needs_browser = pytest.mark.skipif(
    BROWSER is None, reason="no Chromium is installed (Debian, Ubuntu: apt-get install chromium)"
)
