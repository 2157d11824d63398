from aerpaw_cmp.compare.offset import grid_offset as grid_offset
from aerpaw_cmp.compare.rank import channel_rank as channel_rank
from aerpaw_cmp.jobs.notebook import Comparison as Comparison
from aerpaw_cmp.jobs.notebook import Flight as Flight
from aerpaw_cmp.jobs.notebook import ReplayedFlight as ReplayedFlight
from aerpaw_cmp.jobs.notebook import open_flight as open_flight
from aerpaw_cmp.logs.frames import Logs as Logs
from aerpaw_cmp.logs.frames import read as read
from aerpaw_cmp.maps.kriging import OrdinaryKriging as OrdinaryKriging
from aerpaw_cmp.maps.kriging import TrendKriging as TrendKriging
from aerpaw_cmp.maps.variogram import BiExponential as BiExponential
from aerpaw_cmp.maps.variogram import Variogram as Variogram
from aerpaw_cmp.propagation.geometry import Array as Array
from aerpaw_cmp.propagation.geometry import Link as Link
from aerpaw_cmp.propagation.geometry import Poses as Poses
from aerpaw_cmp.propagation.geometry import linear_array as linear_array
from aerpaw_cmp.propagation.geometry import single_element as single_element
from aerpaw_cmp.propagation.replay import Replay as Replay
from aerpaw_cmp.propagation.replay import trace as trace
from aerpaw_cmp.site.antennas import HalfWaveDipole as HalfWaveDipole
from aerpaw_cmp.site.antennas import Isotropic as Isotropic
from aerpaw_cmp.site.site import Site as Site
from aerpaw_cmp.site.siteyaml import load_site as load_site

__version__: str
__all__: list[str]
