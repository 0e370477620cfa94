from .homes.home_import import ImportedHome, import_home
from .objects.object_import import ImportedObject, import_object
from .proposals.proposal import Proposal, Proposals
from .proposals.propose import propose_attachments
from .robots.doctor import Diagnosis, doctor
from .robots.robot_import import ImportedRobot, import_robot

__all__ = [
    "Diagnosis",
    "ImportedHome",
    "ImportedObject",
    "ImportedRobot",
    "Proposal",
    "Proposals",
    "doctor",
    "import_home",
    "import_object",
    "import_robot",
    "propose_attachments",
]
