"""What the Pioneer needs of a simulator: to build the scene, turn the wheels, hold a ball, and cast rays."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Sequence

from sb3_options.envs.pioneer.arena import Box, Cylinder, Placement, Pose, Position

Point = Sequence[float]


class Simulator(ABC):
    """A scene with robot, balls, walls and obstacles, all of it as `sb3_options.envs.pioneer.body` says.

    Balls are known by their index in the `Placement`. `build` comes before everything else but `close`.
    """

    @abstractmethod
    def build(self, placement: Placement, walls: Sequence[Box], obstacles: Sequence[Cylinder]) -> None:
        """Builds the scene anew, everything at rest and the gripper open.

        Nothing of what was simulated before may show in what comes: one seed gives one trajectory, bit for bit.
        """

    @abstractmethod
    def drive(self, left: float, right: float) -> Pose:
        """Simulates one tick of the controllers, 1 / ``CONTROL_RATE`` s.

        Args:
            left: Velocity of the left wheel that its motor strives for, rad/s.
            right: That of the right wheel.

        Returns:
            Where the robot is then.
        """

    @abstractmethod
    def ball(self, ball: int) -> Position:
        """Where the centre of a ball is, m."""

    @abstractmethod
    def hold(self, ball: int) -> None:
        """Closes the gripper on a ball."""

    @abstractmethod
    def take_away(self, ball: int) -> None:
        """Opens the gripper, and puts the ball in it outside of the arena."""

    @abstractmethod
    def is_touching(self, held: int | None) -> bool:
        """Whether the robot, or the ball ``held`` in its gripper, touches walls or obstacles."""

    @abstractmethod
    def ray_fractions(self, starts: Sequence[Point], ends: Sequence[Point]) -> list[float]:
        """How far along each ray the first wall or obstacle is, 0..1; 1 where there is none."""

    @abstractmethod
    def close(self) -> None:
        """Frees what the simulator holds; a second call does nothing."""
