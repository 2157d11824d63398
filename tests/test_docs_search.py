"""The search of the documentation finds what new users look for.

The built site searches with lunr.js: BM25 without length normalisation, titles count 1000 times, and ``search: boost`` of a
page multiplies. Material adds a bonus for pages and for sections with all terms, and lists pages by their best section. The
same formula runs here on the Markdown files, so that the test needs neither mkdocs nor a browser.
"""

import math
import re
from collections import Counter
from pathlib import Path
from typing import NamedTuple

DOCS = Path(__file__).parents[1] / "docs"
# Query: pages of which one must be among the first three hits.
QUERIES = {
    "GPU": "howto/install", "--with": "howto/questions predict calibrate", "how long does it take": "howto/questions performance",
    "what RMSE is good": "howto/questions", "my own CSV": "howto/questions formats", "what is K": "howto/questions vocabulary",
    "add a tower": "howto/questions site flight_yaml", "dBm": "howto/questions vocabulary", "offset": "statistics howto/questions",
    "without Sionna": "howto/install", "cite": "howto/questions paper", "time zone": "howto/questions formats",
    "slurm": "campaign", "RM520N": "howto/questions tap", "matlab": "howto/questions referee", "osm": "howto/own_site site",
    "interval": "intervals", "free space": "statistics ladder numerics howto/questions", "antenna pattern": "howto/antennas",
    "install": "howto/install", "LLVM": "howto/install dependencies", "rank indicator 0 or 1": "howto/questions formats",
    "netcdf": "outputs channel howto/questions", "pixhawk ulog": "formats howto/questions",
}  # fmt: skip


class Section(NamedTuple):
    page: str
    is_page: bool
    boost: float
    title: Counter[str]
    text: Counter[str]


def terms(text: str) -> Counter[str]:
    """Count the stemmed words of a text."""
    words = re.split(r"[\s\-]+", re.sub(r"[`*|#()\[\]{}<>?!.,:;\"']", " ", text.lower()))
    return Counter(re.sub(r"(?<=\w{3})(?:ing|ed|es|s|e)$", "", word) for word in words if word)


def sections() -> list[Section]:
    found = []
    for path in sorted(DOCS.rglob("*.md")):
        page = path.relative_to(DOCS).with_suffix("").as_posix()
        text = path.read_text(encoding="utf-8")
        boost = re.match(r"---\nsearch:\n  boost: (\d+)\n---\n", text)
        text = re.sub(r"\]\([^)]*\)|<!--.*?-->", "]", text[boost.end() if boost else 0 :])
        for number, part in enumerate(re.split(r"^#{1,6} ", text, flags=re.MULTILINE)[1:]):
            title, _, body = part.partition("\n")
            weight = float(boost[1]) if boost else 1.0
            found.append(Section(page, number == 0, weight, terms(title), terms(body)))
    return found


def first_pages(query: str, of: list[Section]) -> list[str]:
    """Return the three pages that the search lists first."""
    words = list(terms(query))
    count = {word: sum(word in section.title or word in section.text for section in of) for word in words}
    scores: dict[str, float] = {}
    for section in of:
        score, matched = 0.0, 0
        for word in words:
            rarity = math.log(1.0 + abs((len(of) - count[word] + 0.5) / (count[word] + 0.5)))
            parts = [(section.title[word], 1000.0), (section.text[word], 1.0)]
            score += sum(rarity * 2.2 * n / (1.2 + n) * weight * section.boost for n, weight in parts)
            matched += any(n for n, _ in parts)
        bonus = section.is_page + matched / len(words)
        scores[section.page] = max(scores.get(section.page, 0.0), score * (1.0 + bonus**2))
    return sorted((page for page in scores if scores[page]), key=lambda page: -scores[page])[:3]


def test_a_new_user_finds_the_page_among_the_first_three_hits() -> None:
    of = sections()
    assert len(QUERIES) == 24
    assert {page for pages in QUERIES.values() for page in pages.split()} <= {section.page for section in of}
    hits = {query: first_pages(query, of) for query in QUERIES}
    missed = {query: found for query, found in hits.items() if not set(found) & set(QUERIES[query].split())}
    assert len(missed) <= 2, missed


def test_a_word_that_no_page_has_finds_nothing() -> None:
    assert first_pages("zyzzyva", sections()) == []
