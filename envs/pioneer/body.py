"""The body of a Pioneer 2-DX with a gripper, and the ball: dimensions, masses, friction, motors, for every simulator.

Dimensions and masses are from ActivMEDIA's "Pioneer 2 Mobile Robot Operation Manual" (1999) for the 2-DX, unless a
constant says otherwise. In the robot's frame x points ahead, y to the left and z up. The origin is on the floor below
the middle of the axle.
"""

from __future__ import annotations

BODY_RADIUS = 0.22
"""m: half of the body's 44 cm length. The body, 44 cm by 38 cm with rounded ends, is simulated as the cylinder in
which it turns. So turning on the spot brings only the gripper nearer to a wall."""

BODY_BOTTOM, BODY_TOP = 0.06, 0.22
"""m above the floor: the deck is at 22 cm, the clearance is rounded up from 5 cm."""

WHEEL_RADIUS = 0.0825
"""m; the wheels' diameter is 16.5 cm."""

AXLE_TRACK = 0.33
"""Distance between the wheels, m."""

CASTER_RADIUS = 0.03
CASTER_BEHIND = 0.18
"""m; the swivelling rear caster is simulated as a ball without friction."""

BODY_MASS, WHEEL_MASS, REAR_MASS = 5.0, 0.5, 3.0
"""kg, 9 kg in all. Batteries and caster are in the rear, which keeps the nose up when the robot brakes."""

PADDLE_OPENING = 0.24
"""Distance between the gripper's open paddles, m. A ball of 16 cm fits if it is up to 4 cm off the middle."""

PADDLE_TIP = 0.34
"""Reach of the paddles ahead of the axle, m."""

PADDLE_HALF_SIDES = (0.08, 0.01, 0.025)
"""Half sides of a paddle along, across and upwards, m."""

PADDLE_HEIGHT = 0.08
"""Height of the paddles' middle above the floor, m."""

MIDDLE_HEIGHT = (BODY_BOTTOM + BODY_TOP) / 2
"""Height of the body's middle above the floor, m. It is the body's origin in the simulators."""

TYRE_FRICTION, CASTER_FRICTION, BODY_FRICTION = 1.0, 0.0, 0.2
"""Coefficients: rubber on carpet, a caster that follows, and painted metal that slides along a wall."""

SOLID_FRICTION = 0.5
"""Coefficient of walls and obstacles. Coefficients of two touching things are multiplied; the floor's is 1."""

BODY_DAMPING = 0.04
"""Damping of the robot's free motion, 1/s."""

MOTOR_TORQUE = 2.0
"""N m per wheel."""

GRIP_AHEAD = 0.31
"""Centre of a ball in the closed gripper, m ahead of the axle: the ball is 1 cm in front of the body."""

GRIP_FORCE = 40.0
"""N; it holds the ball while the robot accelerates, and gives way before it would lift the robot."""

BALL_RADIUS = 0.08
"""m; the ball fits between the open paddles and is lower than the sonar ring."""

BALL_MASS = 0.25
"""kg."""

BALL_FRICTION, BALL_ROLLING_FRICTION, BALL_SPINNING_FRICTION = 0.6, 0.004, 0.002
"""Coefficient, and two lengths in m, of a soft ball on carpet. After a push it rolls some decimetres."""

BALL_DAMPING = 0.3
"""Damping of a ball's motion and rotation, 1/s."""

ASIDE = 100.0
"""Place of balls taken away, x and y in m, outside any arena."""

CONTACT_GAP = 0.002
"""Surfaces touch if they are nearer than this, m."""

GRAVITY = 9.81
"""m/s²."""

PHYSICS_RATE = 60
"""Physics steps per second."""

CONTROL_RATE = 30
"""Decisions of the controllers per second."""
