// Pen and ink: boundaries are drawn, darkest where they are seen edge-on; distant ones fade into the paper.
// Source: Ebert, Rheingans, "Volume illustration: non-photorealistic rendering of volume models", Visualization 2000:
// boundary enhancement, silhouettes, distance colour blending.
#pragma once

#include "user_shader.h"

template <class T>  // float or double
struct Ink : gv::UserShader<T> {
  using gv::UserShader<T>::UserShader;
  GV_UNIFORMS(steep, sharpness, wash, near, far, paper);

  GV_HD void add(const gv::Interval<T>& interval, const gv::Probe<T>& probe, gv::ShadeSum<T>& sum) const {
    gv::Row<T> row = this->look_up(interval.value, interval);
    if (!(row.alpha > 0)) return;
    const gv::Vec3<T> slope = probe.gradient(interval.middle);
    const gv::Vec3<T> normal = gv::unit(slope);
    const T boundary = gv::clamp(gv::dot(slope, normal) / this->uniform(steep), T(0), T(1));
    const T facing = gv::dot(normal, probe.sight.direction);  // 0 at a silhouette
    const T side = gv::clamp(1 - gv::larger(facing, -facing), T(0), T(1));
    const T ink = gv::power_of(side, this->uniform(sharpness));

    const T distance = interval.middle + probe.sight.moved;
    const T haze = gv::clamp((distance - this->uniform(near)) / (this->uniform(far) - this->uniform(near)), T(0), T(1));
    row.red = row.red + haze * (this->uniform(paper) - row.red);
    row.green = row.green + haze * (this->uniform(paper) - row.green);
    row.blue = row.blue + haze * (this->uniform(paper) - row.blue);
    row.alpha = row.alpha * boundary * gv::larger(ink, this->uniform(wash));
    sum.add_normal(normal, sum.clear * row.alpha);
    this->composite(row, interval, sum);
  }
};
