// This file declares what becomes of a sample on a curve, given the surfaces on its sides. In reverse mode it adds
// cotangents of what the curve moves with, in forward mode a derivative of the pixels around it. In screen space it
// adds the gradient by the image position.
//
// Accumulations are compiled once per type of image and number of channels, and curve sources without either. A sample
// is therefore passed through an interface.
#pragma once

#include <concepts>
#include <memory>

#include "accumulate/accumulation.h"
#include "boundary/curve_source.h"
#include "estimator/view.h"

namespace edgegrad {

// MovingSample is a sample with its curve. It offers what MovingCurve requires, for any source.
class MovingSample {
   public:
    virtual Vec2 x() const = 0;
    virtual const CurveSample* on_surfaces() const = 0;  // null on the lens boundary, which has one side
    virtual SampleSurfaces surfaces() = 0;
    virtual CurveJumps jumps(const double* radiance) const = 0;
    virtual CurveJumps velocities(const Direction& direction) const = 0;
    virtual Vec2 normal() const = 0;
    virtual void add_motion(CurveJumps jumps, LocalGradients& grad) = 0;
    virtual void finish(LocalGradients& grad) = 0;

   protected:
    ~MovingSample() = default;
};

template <MovingCurve Source>
class SampleOf final : public MovingSample {
   public:
    SampleOf(Source& source, typename Source::Sample& sample) : source_(source), sample_(sample) {}

    Vec2 x() const override { return sample_.x; }
    const CurveSample* on_surfaces() const override {
        if constexpr (std::derived_from<typename Source::Sample, CurveSample>) return &sample_;
        else return nullptr;
    }
    SampleSurfaces surfaces() override { return source_.surfaces(sample_); }
    CurveJumps jumps(const double* radiance) const override { return source_.jumps(sample_, radiance); }
    CurveJumps velocities(const Direction& direction) const override { return source_.velocities(sample_, direction); }
    Vec2 normal() const override { return source_.normal(sample_); }
    void add_motion(CurveJumps jumps, LocalGradients& grad) override { source_.add_motion(sample_, jumps, grad); }
    void finish(LocalGradients& grad) override { source_.finish(grad); }

   private:
    Source& source_;
    typename Source::Sample& sample_;
};

class CurveAccumulation {
   public:
    virtual ~CurveAccumulation() = default;

    // Returns false if a sample at the pixel position x cannot contribute. i identifies the sample in its batch.
    virtual bool wants(int i, Vec2 x) = 0;

    // Adds a visible sample for which wants() returned true.
    template <MovingCurve Source>
    void add(int i, Source& source, typename Source::Sample& sample) {
        SampleOf<Source> moving(source, sample);
        accumulate(i, moving);
    }

   private:
    virtual void accumulate(int i, MovingSample& sample) = 0;
};

// Makes the accumulation of one chunk of samples.
template <class T>
std::unique_ptr<CurveAccumulation> accumulate_curves(const BackwardView<T>& view, const Accumulation& accumulation,
                                                     LocalGradients& grad);

}  // namespace edgegrad
