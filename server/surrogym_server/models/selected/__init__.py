"""The family that chooses a family for each output, by predictions of steps that were held out."""

from surrogym_server.models.selected.family import SelectedFamilies

__all__ = ["SelectedFamilies"]
