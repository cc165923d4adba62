// The contractions of samples: reverse mode, forward mode, the gradient by places in the image, and the samples
// themselves, for whoever contracts them elsewhere (record.h). What each
// does with a sample inside a face or on a curve stands where these are sampled.
#pragma once

#include "contract/forward.h"
#include "contract/record.h"

namespace edgegrad {

// To cotangents of the parameters; `geometry`: also of what moves inside faces.
struct Reverse {
    bool geometry;
};
// To derivatives of the pixels in several directions.
struct Forward {
    Directions directions;
};
// To the gradient by the places of what is seen, two numbers a pixel.
struct Screen {};

// For explicit instantiations: channels, contraction, type of the image. Forward mode and the gradient by places are
// compiled for any number of channels alone.
#define EDGEGRAD_FOR_CONTRACTIONS(X)       \
    EDGEGRAD_FOR_CONTRACTIONS_OF(X, float) \
    EDGEGRAD_FOR_CONTRACTIONS_OF(X, double)
#define EDGEGRAD_FOR_CONTRACTIONS_OF(X, T) \
    X(0, Reverse, T)                       \
    X(1, Reverse, T)                       \
    X(3, Reverse, T) X(4, Reverse, T) X(-4, Reverse, T) X(0, Forward, T) X(0, Screen, T) X(0, Record, T)

}  // namespace edgegrad
