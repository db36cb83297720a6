"""The closed loop and the open loop, in plain NumPy and compiled; noise, actuators and sensors."""
