"""A course of the car with one obstacle of every kind at least, as an override."""

EVERY_KIND = """{obstacles: [
  {center: [3.4, 0.15], radius: 0.4},
  !Sphere {center: [9.0, 3.0], radius: 0.4, velocity: [0.0, -0.1]},
  !Ellipsoid {center: [1.6, -1.2], semi_axes: [0.5, 0.3]},
  !Capsule {start: [0.0, 2.0], end: [4.0, 2.5], radius: 0.2, velocity: [0.0, 0.01]},
  !Box {center: [2.5, -2.0], half_widths: [0.4, 0.2], rotation: [[0, -1], [1, 0]]},
  !HalfSpace {normal: [0.0, 1.0], offset: -3.0},
  !Geofence {lower: [-1.0, -.inf], upper: [20.0, 4.0], margin: 0.1},
  !StateLimit {state: speed, lower: -0.5, upper: 0.6, gains: [4.0]},
]}"""
