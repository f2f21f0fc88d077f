"""Environments that shine together are seen to be there without being added up."""

import numpy as np
import pytest

from prtbake_storage.errors import PrtError, SettingsError
from prtbake_workers.environment.environment import Environment
from prtbake_workers.environment.summing import AddedLight
from prtbake_workers.jobs.lights import check_light, load_light, share_notes
from support.local_stages import registered


def test_lights_are_checked_one_by_one(store):
    sky, hall = (
        registered(store, "environment", builtin={"name": name, "width": 32})["canonical"]
        for name in ("sun_sky", "hall")
    )
    own = {"digest": sky, "scale": 1.0, "rotation_deg": [0.0, 0.0, 0.0]}
    # a sum would be seen: it is more than a map holds
    bright = {"digest": hall, "scale": 1e39, "rotation_deg": [0.0, 0.0, 0.0]}
    check_light(store, [own, bright])
    with pytest.raises(SettingsError, match="of light 0 makes"):
        load_light(store, [own, bright])
    check_light(store, sky)
    gone = "sha256:" + "0" * 64
    for source in (gone, [own, bright | {"digest": gone}]):
        with pytest.raises(PrtError):
            check_light(store, source)


def test_a_light_that_gives_little_is_not_told_to_give_nothing():
    even = Environment(np.ones((4, 8, 3), np.float32))
    bright, faint = AddedLight(even, 1.0), AddedLight(even, 2e-4)
    (note,) = share_notes([bright, faint])
    assert note.endswith("each gives 99.98%, 0.02%")
    # negative twin: without any light there are no shares
    (note,) = share_notes([AddedLight(even, 0.0)] * 2)
    assert note.endswith("each gives none, none")
