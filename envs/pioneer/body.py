"""The body of a Pioneer 2-DX with a gripper, and the ball: dimensions, masses, friction, motors, for every simulator.

Dimensions and masses are from ActivMEDIA's "Pioneer 2 Mobile Robot Operation Manual" (1999) for the 2-DX, unless a
constant says otherwise. In the robot's frame x points ahead, y to the left and z up. The origin is on the floor below
the middle of the axle.
"""

from __future__ import annotations

# Half of the body's 44 cm length, m. The body, 44 cm by 38 cm with rounded ends, is simulated as the cylinder in which
# it turns. So turning on the spot brings only the gripper nearer to a wall.
BODY_RADIUS = 0.22
BODY_BOTTOM, BODY_TOP = 0.06, 0.22  # m above the floor: the deck is at 22 cm, the clearance is rounded up from 5 cm
MIDDLE_HEIGHT = (BODY_BOTTOM + BODY_TOP) / 2  # m above the floor; the middle is the body's origin in the simulators

WHEEL_RADIUS = 0.0825  # m; the wheels' diameter is 16.5 cm
AXLE_TRACK = 0.33  # distance between the wheels, m
CASTER_RADIUS, CASTER_BEHIND = 0.03, 0.18  # m; the swivelling rear caster is simulated as a ball without friction

# kg, 9 kg in all. Batteries and caster are in the rear, which keeps the nose up when the robot brakes.
BODY_MASS, WHEEL_MASS, REAR_MASS = 5.0, 0.5, 3.0

PADDLE_OPENING = 0.24  # between the open paddles, m. A ball of 16 cm fits if it is up to 4 cm off the middle.
PADDLE_TIP = 0.34  # reach of the paddles ahead of the axle, m
PADDLE_HALF_SIDES = (0.08, 0.01, 0.025)  # along, across and upwards, m
PADDLE_HEIGHT = 0.08  # of the paddles' middle above the floor, m

# Coefficients: rubber on carpet, a caster that follows, and painted metal that slides along a wall.
TYRE_FRICTION, CASTER_FRICTION, BODY_FRICTION = 1.0, 0.0, 0.2
# Of walls and obstacles. Coefficients of two touching things are multiplied; the floor's is 1.
SOLID_FRICTION = 0.5
BODY_DAMPING = 0.04  # of the robot's free motion, 1/s

MOTOR_TORQUE = 2.0  # N m per wheel
GRIP_AHEAD = 0.31  # centre of a ball in the closed gripper, m ahead of the axle: it is 1 cm in front of the body
GRIP_FORCE = 40.0  # N; holds the ball while the robot accelerates, and gives way before it would lift the robot

BALL_RADIUS = 0.08  # m; the ball fits between the open paddles and is lower than the sonar ring
BALL_MASS = 0.25  # kg
# Coefficient, and two lengths in m, of a soft ball on carpet. After a push it rolls some decimetres.
BALL_FRICTION, BALL_ROLLING_FRICTION, BALL_SPINNING_FRICTION = 0.6, 0.004, 0.002
BALL_DAMPING = 0.3  # of its motion and rotation, 1/s
ASIDE = 100.0  # place of balls taken away, x and y in m, outside any arena

CONTACT_GAP = 0.002  # surfaces touch if they are nearer than this, m
GRAVITY = 9.81  # m/s²
PHYSICS_RATE = 60  # physics steps per second
CONTROL_RATE = 30  # decisions of the controllers per second
