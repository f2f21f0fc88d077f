"""The main job through service, workers, SDK and command line, all of them processes."""

import hashlib
import io
import json
from pathlib import Path

import h5py
import numpy as np
import pytest
from PIL import Image
from support.deployment import Installation, until

from prtbake import Asset, InvalidRequest
from prtbake_storage.contract.jobs import JobState
from prtbake_storage.decode.relight import whitened_light
from prtbake_storage.hdf5.resources import read_light
from prtbake_storage.hdf5.transfer import open_transfer

pytestmark = pytest.mark.acceptance
