"""The problem: who flies where among what, with which navigation. Pure data and its validation.

A problem is read from TOML by :func:`napf_mpc.problem_file.load_problem`. Every key carries its unit, is
limited to a range in which the equations make sense, and has a default unless it says who flies where
among what. Unknown keys, text for numbers and numbers that are not finite are refused.
"""

from napf_mpc.problem.formation import Circle, Formation, Line, Listed, Square, Vee
from napf_mpc.problem.mission import FormationMission, GoalMission, Mission
from napf_mpc.problem.navigation import ConstantBias, GaussMarkov, Gnss, Navigation, Recorded
from napf_mpc.problem.planner import Planner
from napf_mpc.problem.problem import Problem
from napf_mpc.problem.section import InitialPosition
from napf_mpc.problem.simulation import Reference, Simulation
from napf_mpc.problem.vehicle import Vehicle
from napf_mpc.problem.world import (
    BoxObstacle,
    City,
    CylinderObstacle,
    EmptyWorld,
    Forest,
    Lanes,
    MovingCylinder,
    MovingObstacle,
    MovingSphere,
    ObstacleItem,
    ObstacleList,
    PrismObstacle,
    Scatter,
    SphereObstacle,
    StreetCanyon,
    World,
)

__all__ = [
    "BoxObstacle",
    "Circle",
    "City",
    "ConstantBias",
    "CylinderObstacle",
    "EmptyWorld",
    "Forest",
    "Formation",
    "FormationMission",
    "GaussMarkov",
    "Gnss",
    "GoalMission",
    "InitialPosition",
    "Lanes",
    "Line",
    "Listed",
    "Mission",
    "MovingCylinder",
    "MovingObstacle",
    "MovingSphere",
    "Navigation",
    "ObstacleItem",
    "ObstacleList",
    "Planner",
    "PrismObstacle",
    "Problem",
    "Recorded",
    "Reference",
    "Scatter",
    "Simulation",
    "SphereObstacle",
    "Square",
    "StreetCanyon",
    "Vee",
    "Vehicle",
    "World",
]
