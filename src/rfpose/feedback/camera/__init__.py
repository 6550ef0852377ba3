"""Focal spots on a target, seen by a camera: rendered pictures, two image chains, searches, corrections.

``render`` makes pictures and shares nothing with what reads them. ``malan`` rectifies by corner markers and weighs by
brightness; ``berenguel`` works in the camera's own pixels and corrects by encoder steps; ``search`` finds a beam that
is not in view; ``model`` is the measurement without pictures, for many heliostats at once.
"""
