"""Ground truth: a simulated hand, and the plant contract."""

from .config import PlantConfig as PlantConfig
from .disturbances import Change as Change
from .disturbances import DisturbedPlant as DisturbedPlant
from .disturbances import Tug as Tug
from .parameters import PlantParameters as PlantParameters
from .pinch import PinchPlan as PinchPlan
from .pinch import PinchPlanner as PinchPlanner
from .pinch_problem import PinchProblem as PinchProblem
from .pinch_problem import PinchRequest as PinchRequest
from .plant import Observation as Observation
from .plant import Plant as Plant
from .plant import PlantStatus as PlantStatus
from .recording import Recording as Recording
from .recording_plant import RecordingPlant as RecordingPlant
from .replayed_plant import ReplayedPlant as ReplayedPlant
from .severities import SEVERITIES as SEVERITIES
from .severities import severity as severity
from .simulated_hand import PlantSnapshot as PlantSnapshot
from .simulated_hand import SimulatedHand as SimulatedHand
from .trial_log import TrialEntry as TrialEntry
from .trial_log import TrialLog as TrialLog
