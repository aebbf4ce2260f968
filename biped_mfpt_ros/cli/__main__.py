"""``python -m biped_mfpt_ros.cli``."""

import sys

from biped_mfpt_ros.cli import main

sys.exit(main())
