"""The body of a Pioneer 2-DX with a gripper, and the ball: dimensions, masses, friction, motors, for every simulator.

Dimensions and masses are those that ActivMEDIA's "Pioneer 2 Mobile Robot Operation Manual" (1999) specifies for the
2-DX, unless a constant says otherwise. In the robot's frame x points ahead, y to the left and z up, and the origin is
on the floor below the middle of the axle.
"""

from __future__ import annotations

BODY_RADIUS = 0.22
"""m: half of the body's 44 cm length. The body, 44 cm by 38 cm with rounded ends, is simulated as the cylinder that
it turns in, so that turning on the spot brings nothing but the gripper nearer to a wall."""

BODY_BOTTOM, BODY_TOP = 0.06, 0.22
"""m above the floor: the deck is at 22 cm; the clearance is rounded up from 5 cm."""

WHEEL_RADIUS = 0.0825
"""m: the wheels' diameter is 16.5 cm."""

AXLE_TRACK = 0.33
"""Between the wheels, m."""

CASTER_RADIUS = 0.03
CASTER_BEHIND = 0.18
"""m; the swivelling rear caster, simulated as a ball without friction."""

BODY_MASS, WHEEL_MASS, REAR_MASS = 5.0, 0.5, 3.0
"""kg, 9 kg in all; the batteries and the caster are in the rear, which keeps the nose up when the robot brakes."""

PADDLE_OPENING = 0.24
"""Between the gripper's open paddles, m; it takes a ball of 16 cm that is up to 4 cm off the middle."""

PADDLE_TIP = 0.34
"""How far the paddles reach ahead of the axle, m."""

PADDLE_HALF_SIDES = (0.08, 0.01, 0.025)
"""Along, across and upwards, m."""

PADDLE_HEIGHT = 0.08
"""Of the paddles' middle above the floor, m."""

MIDDLE_HEIGHT = (BODY_BOTTOM + BODY_TOP) / 2
"""Of the body's middle above the floor, m. It is the body's origin in the simulators."""

TYRE_FRICTION, CASTER_FRICTION, BODY_FRICTION = 1.0, 0.0, 0.2
"""Coefficients: rubber on carpet, a caster that follows, and painted metal that slides along a wall."""

SOLID_FRICTION = 0.5
"""Coefficient of walls and obstacles. That of two things which touch is the product; the floor's is 1."""

BODY_DAMPING = 0.04
"""Of the robot's free motion, 1/s."""

MOTOR_TORQUE = 2.0
"""N m at each wheel."""

GRIP_AHEAD = 0.31
"""Where the closed gripper holds a ball's centre, m ahead of the axle: 1 cm before the body."""

GRIP_FORCE = 40.0
"""N; holds the ball while the robot accelerates, and gives way before it would lift the robot."""

BALL_RADIUS = 0.08
"""m; fits between the gripper's open paddles and is lower than the sonar ring."""

BALL_MASS = 0.25
"""kg."""

BALL_FRICTION, BALL_ROLLING_FRICTION, BALL_SPINNING_FRICTION = 0.6, 0.004, 0.002
"""Coefficient, and two lengths in m: a soft ball on carpet. One that was pushed rolls some decimetres."""

BALL_DAMPING = 0.3
"""Of a ball's motion and rotation, 1/s."""

ASIDE = 100.0
"""Where balls that were taken away lie, x and y in m: outside of any arena."""

CONTACT_GAP = 0.002
"""Things whose surfaces are nearer than this touch, m."""

GRAVITY = 9.81
"""m/s²."""

PHYSICS_RATE = 60
"""Physics steps per second."""

CONTROL_RATE = 30
"""Decisions of the controllers per second."""
