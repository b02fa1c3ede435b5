"""The Pioneer's interface to simulators: build the scene, turn the wheels, hold a ball, and cast rays."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Sequence

from sb3_options.envs.pioneer.arena import Box, Cylinder, Placement, Pose, Position

Point = Sequence[float]


class Simulator(ABC):
    """A scene with robot, balls, walls and obstacles, with the constants of `sb3_options.envs.pioneer.body`.

    Balls are identified by their index in the `Placement`. All methods but `close` need `build` first.
    """

    @abstractmethod
    def build(self, placement: Placement, walls: Sequence[Box], obstacles: Sequence[Cylinder]) -> None:
        """Build a new scene, with everything at rest and the gripper open.

        Earlier simulation must not influence the new scene: one seed gives one trajectory, bit for bit.
        """

    @abstractmethod
    def drive(self, left: float, right: float) -> Pose:
        """Simulate one tick of the controllers, 1 / ``CONTROL_RATE`` s.

        Args:
            left: Target velocity of the left wheel's motor, rad/s.
            right: Target velocity of the right wheel's motor, rad/s.

        Returns:
            The robot's pose after the tick.
        """

    @abstractmethod
    def ball(self, ball: int) -> Position:
        """Return the centre of a ball, m."""

    @abstractmethod
    def hold(self, ball: int) -> None:
        """Close the gripper on a ball."""

    @abstractmethod
    def take_away(self, ball: int) -> None:
        """Open the gripper, and move its ball outside the arena."""

    @abstractmethod
    def is_touching(self, held: int | None) -> bool:
        """Whether the robot, or the ball ``held`` in its gripper, touches walls or obstacles."""

    @abstractmethod
    def ray_fractions(self, starts: Sequence[Point], ends: Sequence[Point]) -> list[float]:
        """Return how far along each ray the first wall or obstacle is, 0..1; 1 without one."""

    @abstractmethod
    def close(self) -> None:
        """Free the simulator's resources; a second call does nothing."""
