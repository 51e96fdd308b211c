"""Third-party odometry methods behind one protocol, by name.

A new one is a class in ``wrapped``, as ``Baseline`` describes it, and a line in ``BASELINES``. Outside the
package, ``scanchain compare --methods my_module:MyClass`` runs a class of yours, given its table of --config as
keywords.
"""

from scanchain.baselines.wrapped import BASELINES as BASELINES
from scanchain.baselines.wrapped import Baseline as Baseline
from scanchain.baselines.wrapped import Entry as Entry
from scanchain.baselines.wrapped import InPlane as InPlane
