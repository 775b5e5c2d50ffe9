"""Small tables, lines and commands that work, as `--example` prints them."""

from collections.abc import Mapping

EXAMPLES: Mapping[str, str] = {
    "tcp": """\
# visioncal tcp THIS_FILE -c OUT --name gripper; OUT: what calibrate wrote (or -o FRAMES.json)
# Of the flange, in the robot's base. point: the tip at one fixed point, tilted each time to another
# side. For the tool's rotation, too: z: the point on the tool's z; xz: beside it, towards its x.
kind,x_m,y_m,z_m,qx,qy,qz,qw
point,0.48998,-0.00246,0.31139,0.95372,0.00000,0.00000,-0.30071
point,0.56431,0.03714,0.32211,0.95372,0.00000,-0.26042,-0.15035
point,0.57339,0.12813,0.32971,0.94552,0.00000,-0.28195,0.16278
point,0.49005,0.16966,0.33431,0.95372,0.00000,0.00000,0.30071
point,0.40620,0.12841,0.31577,0.93969,0.00000,0.29620,0.17101
point,0.41668,0.03770,0.31035,0.95106,0.00000,0.26762,-0.15451
z,0.50085,0.06116,0.44795,0.99905,0.00000,-0.02181,-0.03778
z,0.47212,0.12916,0.44772,0.99452,0.00000,0.03575,0.09822
xz,0.43745,0.06714,0.37084,0.99905,0.00000,-0.02181,-0.03778
xz,0.41794,0.11308,0.36521,0.99452,0.00000,0.03575,0.09822
""",
    "fixture": """\
# visioncal fixture THIS_FILE --tool none -c OUT --name jig; OUT: what calibrate wrote
# Places of the tip, by the controller's own tool; without it poses as of tcp, and --tool gripper.
# With --cad DRAWING: a column point instead of kind, and DRAWING with point, x_mm, y_mm, z_mm.
kind,x_mm,y_mm,z_mm
origin,599.98,-100.01,120.05
origin,600.02,-100.05,120.00
x,703.90,-40.03,122.05
x,773.21,-0.05,123.54
xy,559.65,49.83,125.19
xy,678.63,83.75,126.45
""",
    "plan": """\
# The lens by fx, fy, cx, cy, or a file; camera on the flange and board in the base, roughly: X Y Z
# in mm, and RX RY RZ in degrees about fixed axes. Of a session or a result: visioncal plan SESSION
visioncal plan ur5e --target charuco_9x6_30mm --camera 900,900,640,400 --resolution 1280,800 \\
  --cam '0 0 80 0 0 0' --board '450 0 0 180 0 0'
""",
    "correct": """\
# visioncal correct THIS_FILE --against OUT; OUT: a result whose arm was calibrated by joint angles
# Of the flange (--tool: of a tool) in the base; or X, Y, Z, A, B, C as the controller has them.
x_m,y_m,z_m,qx,qy,qz,qw
0.60,-0.10,0.30,1,0,0,0
0.60,0.20,0.25,0.98481,0,0,0.17365
""",
    "locate": """\
# A pixel needs its plane (its height in the base, in mm, or a fixture's name) and, of a camera on
# the flange, the flange's pose. A board needs neither: visioncal locate SESSION -c OUT
visioncal locate -c OUT --pixel 640,400 --plane z=20 --pose 0.5,0.1,0.4,0,1,0,0
""",
    "history": """\
# OUT: a folder that calibrate wrote or verify -o, one above many, or a file of frames
visioncal history visioncal-history.db --add OUT
""",
    "guard": """\
{"time_s": 0.0, "base_from_flange": [0.5, 0.1, 0.4, 0, 1, 0, 0], \
"cam_from_target": [0.01, -0.02, 0.4, 0, 0, 0, 1]}
{"acknowledge": true}
""",
}
