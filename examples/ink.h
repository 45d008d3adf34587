// Pen and ink: what turns its side to the eye is drawn in dark, dense lines, what faces it is thin, and what is far fades
// into the paper. Source: Ebert, Rheingans, "Volume illustration: non-photorealistic rendering of volume models",
// Visualization 2000, sections 4.2 (silhouettes) and 4.3 (distance colour).
#pragma once

#include "user_shader.h"

template <class T>  // float or double
struct Ink : gv::UserShader<T> {
  using gv::UserShader<T>::UserShader;
  GV_UNIFORMS(sharpness, thinness, near, far, paper);

  GV_HD void add(const gv::Piece<T>& piece, const gv::Probe<T>& probe, gv::ShadeSum<T>& sum) const {
    gv::Row<T> row = this->look_up(piece.value, piece);
    if (!(row.alpha > 0)) return;
    const gv::Vec3<T> normal = this->light.normal(probe, piece.middle);
    const T facing = -gv::dot(normal, probe.sight.direction);  // 1 towards the eye, 0 at a silhouette
    const T edge = gv::power_of(gv::clamp(1 - facing, T(0), T(1)), this->uniform(sharpness));
    const T distance = piece.middle + probe.sight.moved;
    const T haze = gv::clamp((distance - this->uniform(near)) / (this->uniform(far) - this->uniform(near)), T(0), T(1));

    const T dark = 1 - edge;
    for (T* number : {&row.red, &row.green, &row.blue}) {
      *number = *number * dark + haze * (this->uniform(paper) - *number * dark);
    }
    row.alpha = row.alpha * (this->uniform(thinness) + (1 - this->uniform(thinness)) * edge);
    sum.add_normal(normal, sum.clear * row.alpha);
    this->composite(row, piece, sum);
  }
};
