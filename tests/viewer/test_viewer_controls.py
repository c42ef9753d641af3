"""What someone who opens a page for the first time meets. Skipped without Chromium."""

from pathlib import Path

import numpy as np

from tests.viewer.browser import chromium, driven, image_of
from tests.viewer.test_viewer_agreement import shown

_FIRST_LOOK = """
    const text = (id) => byId(id).textContent;
    const seen = { hint: [byId("hint").hidden], text: text("hint") };
    byId("view").dispatchEvent(new PointerEvent("pointerdown", { bubbles: true, button: 2 }));
    seen.hint.push(byId("hint").hidden);
    for (let i = 0; i < 2; i++) {
      byId("add").click();
      await frames(3);
    }
    await settled();
    seen.command = text("command");
    for (let i = 0; i < 3; i++) {
      byId("remove").click();
      await frames(3);
    }
    seen.dark = [text("command"), text("message")];
    byId("add").click();
    await frames(3);
    await settled();
    seen.again = text("message");
    return seen;
"""
_GUESS = """
    const refine = LightField.prototype.refine;
    let later = null;
    LightField.prototype.refine = function (...given) {
      later = () => refine.apply(this, given);
    };
    location.hash = "light=-140,-26&ev=4";
    while (!later) await frames(1);
    const guess = byId("view").toDataURL();
    LightField.prototype.refine = refine;
    later();
    await settled();
    return [guess, byId("view").toDataURL()];
"""


def test_a_page_says_how_it_is_used_and_what_is_missing(tmp_path: Path) -> None:
    chromium()
    seen = driven(shown().text, _FIRST_LOOK, tmp_path)
    assert seen["hint"] == [False, True] and "Drag over the face" in seen["text"]
    lights = seen["command"].split("'")[1].split(";")
    assert len(lights) == 3 == len(set(lights))  # none on another
    command, message = seen["dark"]
    assert command.startswith("# add a light") and "No light is on" in message
    assert seen["again"] == ""


def test_the_first_guess_of_a_light_from_behind_is_not_noise(tmp_path: Path) -> None:
    """The face is nearly black there; the steps of the factors' bytes are not shown as colours."""
    chromium()
    guess, exact = map(image_of, driven(shown().text, _GUESS, tmp_path))
    inside = shown().whole.matte > 0.5
    dark = inside & (exact[..., :3].max(-1) < 24)
    assert dark.mean() > 0.1
    assert np.abs(guess - exact)[inside].mean() < 0.5  # 0.15; of noise 1
    assert np.percentile(guess[..., :3].max(-1)[dark], 98) < 30  # 17; of noise 61
