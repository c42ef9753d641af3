"""What someone who opens a page for the first time meets. Skipped without Chromium."""

from pathlib import Path

from tests.viewer.browser import chromium, driven
from tests.viewer.test_viewer_agreement import shown

_FIRST_LOOK = """
    const command = () => byId("command").textContent;
    const seen = { first: command(), message: byId("message").textContent };
    for (let i = 0; i < 12; i++) {
      byId("add").click();
      await frames(3);
    }
    seen.most = command();
    const box = byId("view").getBoundingClientRect();
    seen.size = [box.width, box.height];
    seen.room = document.querySelector("aside").getBoundingClientRect().left - box.right;
    const press = { bubbles: true, pointerId: 1, clientX: box.right - 1, clientY: box.top + box.height / 2 };
    byId("view").setPointerCapture = () => {};
    byId("view").dispatchEvent(new PointerEvent("pointerdown", press));
    await frames(3);
    seen.dragged = [Number(byId("azimuth").value), Number(byId("elevation").value)];
    for (let i = 0; i < 10; i++) {
      byId("remove").click();
      await frames(3);
    }
    seen.dark = command();
    byId("compare").click();
    await frames(3);
    seen.before = [byId("before").hidden, byId("before").naturalWidth];
    return seen;
"""


def test_a_page_begins_with_a_light_and_takes_nine(tmp_path: Path) -> None:
    chromium()
    seen = driven(shown().text, _FIRST_LOOK, tmp_path)
    assert "--light '40,25'" in seen["first"] and seen["message"] == ""
    lights = seen["most"].split("'")[1].split(";")
    assert len(lights) == 9 == len(set(lights))  # none on another
    width, height = seen["size"]
    assert seen["room"] >= 0 and abs(width - height) < 1  # square, and not over the panel
    azimuth, elevation = seen["dragged"]
    assert azimuth > 60 and abs(elevation) < 40  # the picture's right side
    assert seen["dark"].startswith("# add a light")
    assert seen["before"] == [False, 384]
