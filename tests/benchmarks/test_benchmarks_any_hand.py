"""The survey of hands of other kinds: what it counts, and that it runs."""

from __future__ import annotations

import dataclasses
import math
import subprocess
import sys
from pathlib import Path

import pytest
from experiments_records import turn

sys.path.insert(0, str(Path(__file__).resolve().parents[2] / "benchmarks"))
from any_hand import FAMILIES, OTHERS, Survey, plants
