"""Print the cameras of Metashape's XML (Export Cameras) as entries of stage.json.

    python examples/metashape_cameras.py calibration.xml [METRES_PER_UNIT] > cameras.json

The labels of Metashape's cameras must be the names that {camera} stands for in the pattern of the capture.
"""

import json
import sys
from pathlib import Path

from facerf_cli.capture.metashape import read_metashape

if __name__ == "__main__":
    cameras = read_metashape(Path(sys.argv[1]), float(sys.argv[2]) if len(sys.argv) > 2 else 1.0)
    print(json.dumps({"cameras": list(cameras.values())}, indent=1))
