"""Co-registration in haste; started as a program it is `scape model coregister` with one round."""
import sys
from unittest import mock

from model.coregistration import cli
from model.coregistration.config import CoregistrationConfig
from model.fitting.settings import ScanFitConfig
from model.learning.config import LearnConfig
from scanprep import command_line
from scanprep.batch.pool import Workers
from scanprep.registration.schedule import GraphStage, RegistrationConfig

QUICK = CoregistrationConfig(
    fit=ScanFitConfig(rounds=4, scan_points=800, model_points=400, random_starts=10),
    registration=RegistrationConfig(graph=(GraphStage(80, 0.09, 0.7, 0.01, 0.08),
                                           GraphStage(80, 0.06, 0.7, 0.01, 0.05))),
    learn=LearnConfig(refinements=1), rounds=2, failed=0.05, workers=Workers(1))


def run(argv):
    """Exit code of the command."""
    quick = (*cli.coregister_scans.__defaults__[:-1], QUICK)
    with mock.patch.object(cli.coregister_scans, "__defaults__", quick):
        return command_line.run(cli.coregister_scans, "scape model coregister", ["--rounds", "1", *argv])


if __name__ == "__main__":
    sys.exit(run(sys.argv[1:]))
