from .diagnosis import add_effect as add_effect
from .diagnosis import diagnose as diagnose
from .effects import Effect as Effect
from .effects import Parameter as Parameter
from .effects import check_effect as check_effect
from .effects import effect as effect
from .effects import get_effect as get_effect
from .effects import list_effects as list_effects
from .effects import load_effects as load_effects
from .errors import AskError as AskError
from .errors import CatalogueError as CatalogueError
from .errors import EffectError as EffectError
from .errors import ImportFileError as ImportFileError
from .errors import ModelError as ModelError
from .errors import RecordingError as RecordingError
from .errors import SettingsError as SettingsError
from .errors import SocastError as SocastError
from .estimators import RecipeRegressor as RecipeRegressor
from .evaluation import assess_condition as assess_condition
from .evaluation import compare_before_after as compare_before_after
from .evaluation import compare_datasets as compare_datasets
from .evaluation import compare_models as compare_models
from .evaluation import evaluate_recipes as evaluate_recipes
from .evaluation import evaluate_soc_forecasts as evaluate_soc_forecasts
from .evaluation import split_energy as split_energy
from .evaluation import trace_ride as trace_ride
from .models import LinearModel as LinearModel
from .models import fit_model as fit_model
from .models import list_recipes as list_recipes
from .models import load_model as load_model
from .models import save_model as save_model
from .models import stamp_model as stamp_model
from .pipeline import Message as Message
from .pipeline import Pipeline as Pipeline
from .pipeline import Settings as Settings
from .recordings import Tables as Tables
from .recordings import make_tables as make_tables
from .recordings import read_forecasts as read_forecasts
from .recordings import read_messages as read_messages
from .recordings import read_samples as read_samples
from .recordings import read_tables as read_tables
from .results import AdditionTrial as AdditionTrial
from .results import Comparison as Comparison
from .results import Diagnosis as Diagnosis
from .results import RecipeEvaluation as RecipeEvaluation
from .results import SocEvaluation as SocEvaluation
from .simulation import simulate_fleet as simulate_fleet

__all__ = [
    "AdditionTrial",
    "AskError",
    "CatalogueError",
    "Comparison",
    "Diagnosis",
    "Effect",
    "EffectError",
    "ImportFileError",
    "LinearModel",
    "Message",
    "ModelError",
    "Parameter",
    "Pipeline",
    "RecipeEvaluation",
    "RecipeRegressor",
    "RecordingError",
    "Settings",
    "SettingsError",
    "SocEvaluation",
    "SocastError",
    "Tables",
    "add_effect",
    "assess_condition",
    "check_effect",
    "compare_before_after",
    "compare_datasets",
    "compare_models",
    "diagnose",
    "effect",
    "evaluate_recipes",
    "evaluate_soc_forecasts",
    "fit_model",
    "get_effect",
    "list_effects",
    "list_recipes",
    "load_effects",
    "load_model",
    "make_tables",
    "read_forecasts",
    "read_messages",
    "read_samples",
    "read_tables",
    "save_model",
    "simulate_fleet",
    "split_energy",
    "stamp_model",
    "trace_ride",
]
