"""The columns of the arrays that pass between the stages, and the sizes they agree on."""

# A splat [16] float32, one cache line; BASE_* hold int32, the REST what float32 leaves over.
# alpha = 2^(LOG_OPACITY - (A dx + B dy)^2 - (C dy)^2), the centre at (BASE_X + X, BASE_Y + Y).
X, Y, A, B, C, LOG_OPACITY, RED, GREEN, BLUE, DEPTH = range(10)
BASE_X, BASE_Y, A_REST, B_REST, DEPTH_REST, REACH_Y = range(10, 16)
SPLAT = 16

# Gradients [10] float32 of a splat in one tile; those of A, B, C, LOG_OPACITY less a factor ln 2.
G_X, G_Y, G_A, G_B, G_C, G_LOG_OPACITY, G_RED, G_GREEN, G_BLUE, G_DEPTH = range(10)
GRADIENT = 10

TILE = 16  # pixels a side
BLOCK = 2048  # Gaussians of a piece of work; more, where an image would have over MOST_BLOCKS
MOST_BLOCKS = 64

# What a skip leaves standing, so that rounding never drops what a pixel would have shown.
EXPONENT_MARGIN = 1e-3  # of log2 alpha
PIXEL_MARGIN = 1e-3

FARTHEST = 2.0**30  # pixels; of a centre far outside the image, the rest stands in X and Y

# Counters of the projection: tiles that boxes would touch in the place of ellipses; Gaussians that
# were culled by their opacity; those that were culled outside the image.
BOXES, FAINT, OUTSIDE = range(3)
PROJECT_COUNTERS = 3

# Counters of a tile: rows of splats that were drawn; that were in reach before rows got opaque.
ROWS, ROWS_IN_REACH = range(2)
COUNTERS = 2
