"""A hook of mkdocs: links out of docs/ become text, since the site has no page for them."""

import re


def on_page_markdown(markdown: str, **_: object) -> str:
    """Drop the targets of links to files beside docs/."""
    return re.sub(r"\[([^\]]+)\]\(\.\./[^)]+\)", r"\1", markdown)
