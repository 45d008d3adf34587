// The user-defined shader that workload `shaders` measures: the plain transfer function.
#pragma once

#include "user_shader.h"

template <class T>
struct PlainTransfer : gv::UserShader<T> {
  using gv::UserShader<T>::UserShader;

  GV_HD void add(const gv::Piece<T>& piece, const gv::Probe<T>&, gv::ShadeSum<T>& sum) const {
    this->composite(this->look_up(piece.value, piece), piece, sum);
  }
};
