"""A peer on Eclipse Cyclone DDS that pulls the tendon, turns the burr and one joint of the arm, prints "moving" once all
move, and continues.

    python drive_on.py TENSION_N
"""

import sys
import time

from cyclone_peer import Header, JointState, Time, best_effort, reader, writer

LIMIT_S = 120.0
PERIOD_S = 0.05

motor, arm = reader(JointState, "/CM/bend_motor/measured_js", best_effort), reader(JointState, "/UR5/measured_js", best_effort)
burr = reader(JointState, "/CM/burr/measured_js", best_effort)
servo_jf, arm_jv = writer(JointState, "/CM/bend_motor/servo_jf"), writer(JointState, "/UR5/servo_jv")
burr_jv = writer(JointState, "/CM/burr/servo_jv")
header = Header(Time(0, 0), "")
tension_n = float(sys.argv[1])
newest, said = {}, False

deadline = time.monotonic() + LIMIT_S
while time.monotonic() < deadline:
    servo_jf.write(JointState(header, [], [], [], [tension_n, 0.0]))
    arm_jv.write(JointState(header, [], [], [0.0, 0.0, 0.0, 0.0, 0.0, 0.02], []))
    burr_jv.write(JointState(header, [], [], [200.0], []))
    for name, source in (("motor", motor), ("arm", arm), ("burr", burr)):
        newest.update({name: sample for sample in source.take(50)})
    all_move = len(newest) == 3 and newest["burr"].velocity[0] > 100.0 and abs(newest["arm"].velocity[5]) > 0.01
    if all_move and abs(newest["motor"].effort[0] - tension_n) < 0.05 and not said:
        print("moving", flush=True)
        said = True
    time.sleep(PERIOD_S)
sys.exit(f"still alive after {LIMIT_S} s; {newest}")
