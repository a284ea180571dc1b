"""Mask R-CNN (He et al. 2017) with a CFPN mask branch, in plain torch."""
