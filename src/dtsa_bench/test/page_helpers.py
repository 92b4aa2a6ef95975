"""Pages in tests: what they load."""

from __future__ import annotations

import re


def check_loads_nothing(page: str) -> None:
    """A page has scripts of its own, which its policy forbids to load anything, and nothing else that is executed."""
    scripts = r'<script>.*?</script>|<script type="application/json" id="data">.*?</script>'
    shown = re.sub(scripts, "", page, flags=re.S)
    assert not re.search(
        r"<(script|link|img|iframe|object|embed|base)\b|<[^>]* (src|href|srcset|data)=(?![\"']?#)", shown
    )
    assert not re.search(r"@import|url\((?!#|data:)", page)
    assert page.count("</script>") == 2
    assert "default-src 'none'" in page
