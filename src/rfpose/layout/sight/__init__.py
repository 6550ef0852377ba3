"""What stands between transmitters and receivers, and between mirrors and the sun."""

from rfpose.layout.sight.visibility import Plates, Tower, discs_lit, lit_share, visible

__all__ = ["Plates", "Tower", "discs_lit", "lit_share", "visible"]
