"""The kernels: a program takes a block of channels through a band of tokens."""

import triton.language as tl

from asysplat.kernels.triton_utils import kernel


@kernel
def locate(channels, BLOCK: tl.constexpr):
    """Return the band, the channels, which of them exist, and the sequence of a program."""
    channel = tl.program_id(1) * BLOCK + tl.arange(0, BLOCK)
    return tl.program_id(0), channel, channel < channels, tl.program_id(2).to(tl.int64)


@kernel
def load_tokens(array, first, stride, length, mask, NUM: tl.constexpr, UNIT: tl.constexpr):
    """Return NUM tokens from the first on in fp32, zeros where there is no token or channel.

    `array` points to the channels of token 0.
    """
    rows = ()
    place = array + first.to(tl.int64) * stride * UNIT
    for k in tl.static_range(NUM):
        exists = mask & (first + k >= 0) & (first + k < length)
        row = tl.load(place + k * stride * UNIT, mask=exists, other=0.0)
        rows = rows + (row.to(tl.float32),)
    return rows


@kernel
def load_taps(weight, bias, channel, mask, SIZE: tl.constexpr):
    """Return the weights and, last, the bias of channels."""
    taps = ()
    for k in tl.static_range(SIZE):
        taps = taps + (tl.load(weight + channel * SIZE + k, mask=mask, other=0.0),)
    last = tl.zeros_like(taps[0])
    if bias is not None:
        last = tl.load(bias + channel, mask=mask, other=0.0)
    return taps + (last,)


@kernel
def convolve(rows, taps, START: tl.constexpr, SIZE: tl.constexpr):
    """Return the convolution of the SIZE rows from START on."""
    x = taps[SIZE]
    for k in tl.static_range(SIZE):
        x += taps[k] * rows[START + k]
    return x


@kernel
def multiply_slopes(grads, rows, taps, NUM: tl.constexpr, START: tl.constexpr, SIZE: tl.constexpr):
    """Return NUM gradients of outputs times the slopes of silu at the convolutions of the rows."""
    products = ()
    for k in tl.static_range(NUM):
        x = convolve(rows, taps, START + k, SIZE)
        sigmoid = tl.sigmoid(x)
        products = products + (grads[k] * sigmoid * (1 + x * (1 - sigmoid)),)
    return products


@kernel
def forward_band(
    tokens,
    weight,
    bias,
    y,
    sequence_stride,  # units from a sequence to the next
    stride,  # units from a token to the next
    length,
    channels,
    UNIT: tl.constexpr,
    SIZE: tl.constexpr,
    BEFORE: tl.constexpr,
    BAND: tl.constexpr,
    BLOCK: tl.constexpr,
):
    """Write the silu of the convolution of a band."""
    band, channel, exists, batch = locate(channels, BLOCK)
    first = band * BAND
    array = tokens + batch * sequence_stride * UNIT + channel
    rows = load_tokens(array, first - BEFORE, stride, length, exists, BAND + SIZE - 1, UNIT)
    taps = load_taps(weight, bias, channel, exists, SIZE)
    place = y + (batch * length + first) * channels + channel
    for k in tl.static_range(BAND):
        x = convolve(rows, taps, k, SIZE)
        result = (x * tl.sigmoid(x)).to(y.dtype.element_ty)
        tl.store(place + k * channels, result, mask=exists & (first + k < length))


@kernel
def backward_band(
    tokens,
    grad_output,
    weight,
    bias,
    grad_tokens,
    parts,  # [B, bands, SIZE + 1, C], the band's gradients of the weights and, last, the bias
    sequence_stride,  # units from a sequence to the next
    stride,  # units from a token to the next
    length,
    channels,
    g_sequence_stride,
    g_stride,
    UNIT: tl.constexpr,
    G_UNIT: tl.constexpr,
    SIZE: tl.constexpr,
    BEFORE: tl.constexpr,
    STEP: tl.constexpr,
    STEPS: tl.constexpr,
    BLOCK: tl.constexpr,
):
    """Write the gradients of a band."""
    band, channel, exists, batch = locate(channels, BLOCK)
    array = tokens + batch * sequence_stride * UNIT + channel
    g_array = grad_output + batch * g_sequence_stride * G_UNIT + channel
    taps = load_taps(weight, bias, channel, exists, SIZE)
    MORE: tl.constexpr = SIZE - 1
    first = band * STEP * STEPS
    # The tokens before the band, and the gradients before the silu of those whose convolution
    # reaches into it.
    rows = load_tokens(array, first - MORE, stride, length, exists, 2 * MORE, UNIT)
    grads = load_tokens(g_array, first + BEFORE - MORE, g_stride, length, exists, MORE, G_UNIT)
    grads = multiply_slopes(grads, rows, taps, MORE, 0, SIZE)
    totals = ()
    for _ in tl.static_range(SIZE + 1):
        totals = totals + (tl.zeros_like(taps[SIZE]),)
    for _ in range(STEPS):
        more = load_tokens(g_array, first + BEFORE, g_stride, length, exists, STEP, G_UNIT)
        rows = rows + load_tokens(array, first + MORE, stride, length, exists, STEP, UNIT)
        grads = grads + multiply_slopes(more, rows, taps, STEP, MORE, SIZE)
        place = grad_tokens + (batch * length + first) * channels + channel
        for k in tl.static_range(STEP):
            grad = taps[0] * grads[k + MORE]
            for j in tl.static_range(1, SIZE):
                grad += taps[j] * grads[k + MORE - j]
            grad = grad.to(grad_tokens.dtype.element_ty)
            tl.store(place + k * channels, grad, mask=exists & (first + k < length))
            g, sums = grads[k + MORE - BEFORE], ()
            for j in tl.static_range(SIZE):
                sums = sums + (totals[j] + g * rows[k + MORE - BEFORE + j],)
            totals = sums + (totals[SIZE] + g,)
        rows, grads = rows[STEP:], grads[STEP:]
        first += STEP
    part = parts + (batch * tl.num_programs(0) + band) * (SIZE + 1) * channels + channel
    for k in tl.static_range(SIZE + 1):
        tl.store(part + k * channels, totals[k], mask=exists)
