// The user-defined shader that workload `shaders` measures: the plain transfer function.
#pragma once

#include "user_shader.h"

template <class T>
struct PlainTransfer : gv::UserShader<T> {
  using gv::UserShader<T>::UserShader;

  GV_HD void add(const gv::Interval<T>& interval, const gv::Probe<T>&, gv::ShadeSum<T>& sum) const {
    this->composite(this->look_up(interval.value, interval), interval, sum);
  }
};
