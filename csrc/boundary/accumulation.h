// What becomes of a sample on a curve, given the surfaces on its sides: in reverse mode cotangents of what the curve
// moves with, in forward mode a derivative of the pixels around it, or the gradient by its place in the image.
//
// Accumulations are compiled once for each type of image and number of channels, sources of curves without either: a
// sample is handed over through an interface.
#pragma once

#include <concepts>
#include <memory>

#include "accumulate/accumulation.h"
#include "boundary/curve_source.h"
#include "estimator/view.h"

namespace edgegrad {

// A sample and its curve: what MovingCurve offers, of whichever source.
class MovingSample {
   public:
    virtual Vec2 x() const = 0;
    virtual const CurveSample* on_surfaces() const = 0;  // null along the border of a lens, where there is one side
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

    // False if nothing could come of a sample at the pixel position x; i tells the samples of a batch apart.
    virtual bool wants(int i, Vec2 x) = 0;

    // One that it wanted, and that is visible.
    template <MovingCurve Source>
    void add(int i, Source& source, typename Source::Sample& sample) {
        SampleOf<Source> moving(source, sample);
        contract(i, moving);
    }

   private:
    virtual void contract(int i, MovingSample& sample) = 0;
};

// Of the samples of one chunk.
template <class T>
std::unique_ptr<CurveAccumulation> accumulate_curves(const BackwardView<T>& view, const Accumulation& accumulation,
                                                     LocalGradients& grad);

}  // namespace edgegrad
