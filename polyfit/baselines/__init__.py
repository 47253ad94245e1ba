"""Networks of others that PolyFit is held against: PointNet and DGCNN regressing jets, AtlasNet
generating surfaces.
"""
