"""The site of the documents: pages made of other files, and links; `make docs` builds all of it, strictly."""

import pytest

from tools import pages

FILES = {"index.md", "paper.md", "lights.md", "changelog.md"}


@pytest.mark.parametrize(
    ("uri", "link", "becomes"),
    [
        (
            "paper.md",
            "(../examples/README.md#a)",
            "(https://github.com/facerf/facerf/blob/main/examples/README.md#a)",
        ),
        ("index.md", "(benchmarks)", "(https://github.com/facerf/facerf/tree/main/benchmarks)"),
        ("lights.md", "(../README.md#use)", "(index.md#use)"),
        ("index.md", "(docs/gone.md)", "(gone.md)"),  # which mkdocs refuses
        ("paper.md", "(https://host/x.md)", "(https://host/x.md)"),
    ],
)
def test_links_lead_to_pages_or_to_the_repository(uri: str, link: str, becomes: str) -> None:
    assert pages.linked(uri, f"[a]{link}", FILES) == f"[a]{becomes}"


def test_a_verb_has_a_page_of_its_manual_and_of_its_own_verbs() -> None:
    page = "\n".join(pages._manual("face-model"))
    assert page.startswith("# facerf face-model\n") and "\n## facerf face-model import\n" in page
    assert "`-o, --output FILE.npz`\n:   File to write" in page and "\\-" not in page
    assert "```sh\nfacerf face-model import " in page
    assert "relight-dataset" not in "\n".join(pages._manual("relight"))


def test_text_of_the_manual_is_shown_literally() -> None:
    assert pages._text(r"a_b `c_d` \-\-x <y> \fBz\fR") == r"a\_b `c_d` --x &lt;y> z"


def test_lists_are_written_as_python_markdown_reads_them() -> None:
    page = "a:\n- b\n\n  ```sh\n  c\n  ```\n- d\n- e\n1. f\n   g\n\nh\n\n```\n- i\n  j\n```"
    read = "a:\n\n- b\n\n    ```sh\n    c\n    ```\n\n- d\n- e\n1. f\n    g\n\nh\n\n```\n- i\n  j\n```"
    assert pages.linked("paper.md", page, FILES) == read
