"""An example of a program for hardware=process: a point mass in the wind, in plain Python without simbias.

    python -m simbias ... hardware=process hardware.command="python3 echo_robot.py"

It reads a request from standard input, runs the loop itself, and writes a trajectory to standard output. A
program for a real robot does the same: send u, wait for the next frame, read x; and stop beyond the limits.
On SIGTERM it brings the robot to rest within a second.
"""

import json
import sys

WIND = 2.0  # N


def main() -> None:
    request = json.load(sys.stdin)
    dt, frames = request["time_step"], request["frames"]
    spring, damper, force = request["policy"]["parameters"]
    limit = request["inputs"][0]["limit"]
    distance = next(each["limit"] for each in request["failure"] if each["name"] == "distance")
    position, velocity = (state["start"] for state in request["states"])
    states, inputs = [[position, velocity]], []
    for _ in range(frames):
        u = max(-limit, min(limit, force - spring * position - damper * velocity))
        velocity += dt * (u + WIND)
        position += dt * velocity
        states.append([position, velocity])
        inputs.append([u])
        if abs(position) > distance:
            break
    print("the example has run", file=sys.stderr)
    json.dump({"states": states, "inputs": inputs}, sys.stdout)


if __name__ == "__main__":
    main()
