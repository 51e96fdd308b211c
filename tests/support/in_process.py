"""Methods of a comparison run by this process, not by one each, which takes two seconds to start."""

from pathlib import Path

from scanchain.comparison import worker
from scanchain.processes import Ending, KilledFor
from tests.support.scenes import ROOT

SUPPORT = ROOT / "tests" / "support"  # where the class of a method such as bad_odometries:Shifted lies


def here(patch):
    """Let comparisons start no processes as long as a patch lasts."""

    def run_here(limits, module, arguments, environment, *, output, stop=None):
        worker.run(Path(arguments[0]))
        return Ending(0, KilledFor.NOTHING, 0.0, 0.0)

    patch.syspath_prepend(SUPPORT)
    patch.setattr("scanchain.comparison.processes.run_within", run_here)
