// SE(2) and SE(3), the only code that is specialised by dimension. The tangent vector is delta =
// (translation dt, rotation dr) and acts as y = t + dt + Exp(dr) R p: the rotation is about the
// sensor, not about the origin of the map.
#pragma once

#include <Eigen/Dense>
#include <array>
#include <cmath>

namespace stillmap {

template <int D>
struct Lie {
  static constexpr int kRotation = D == 2 ? 1 : 3;
  static constexpr int kDof = D + kRotation;
  using Matrix = Eigen::Matrix<double, D, D>;
  using Vector = Eigen::Matrix<double, D, 1>;
  using Tangent = Eigen::Matrix<double, kDof, 1>;
  using Jacobian = Eigen::Matrix<double, D, kDof>;

  static Matrix exp_rotation(const Eigen::Matrix<double, kRotation, 1>& w) {
    if constexpr (D == 2) {
      return Eigen::Rotation2Dd(w[0]).toRotationMatrix();
    } else {
      const double angle = w.norm();
      if (angle < 1e-12) return Matrix::Identity() + skew(w);
      return Eigen::AngleAxisd(angle, w / angle).toRotationMatrix();
    }
  }

  static Eigen::Matrix<double, kRotation, 1> log_rotation(const Matrix& R) {
    if constexpr (D == 2) {
      return Eigen::Matrix<double, 1, 1>(std::atan2(R(1, 0), R(0, 0)));
    } else {
      const Eigen::AngleAxisd aa(R);
      return aa.angle() * aa.axis();
    }
  }

  // d y / d delta at delta = 0 of an end point with lever arm R p, in the map frame.
  static Jacobian jacobian(const Vector& arm) {
    Jacobian J;
    J.template leftCols<D>().setIdentity();
    if constexpr (D == 2) {
      J(0, 2) = -arm[1];
      J(1, 2) = arm[0];
    } else {
      J.template rightCols<3>() = -skew(arm);
    }
    return J;
  }

  static Eigen::Matrix3d skew(const Eigen::Vector3d& v) {
    Eigen::Matrix3d S;
    S << 0, -v[2], v[1], v[2], 0, -v[0], -v[1], v[0], 0;
    return S;
  }
};

template <int D>
struct Pose {
  Eigen::Matrix<double, D, D> R = Eigen::Matrix<double, D, D>::Identity();
  Eigen::Matrix<double, D, 1> t = Eigen::Matrix<double, D, 1>::Zero();

  Eigen::Matrix<double, D, 1> operator*(const Eigen::Matrix<double, D, 1>& p) const {
    return R * p + t;
  }

  Pose operator*(const Pose& other) const {
    Pose out;
    out.R = R * other.R;
    out.t = R * other.t + t;
    return out;
  }

  Pose inverse() const {
    Pose out;
    out.R = R.transpose();
    out.t = -(out.R * t);
    return out;
  }

  Pose boxplus(const typename Lie<D>::Tangent& delta) const {
    Pose out;
    out.R = Lie<D>::exp_rotation(delta.template tail<Lie<D>::kRotation>()) * R;
    out.t = t + delta.template head<D>();
    return out;
  }

  // delta with other.boxplus(delta) = *this.
  typename Lie<D>::Tangent boxminus(const Pose& other) const {
    typename Lie<D>::Tangent delta;
    delta.template head<D>() = t - other.t;
    delta.template tail<Lie<D>::kRotation>() = Lie<D>::log_rotation(R * other.R.transpose());
    return delta;
  }
};

// From a row-major homogeneous matrix.
template <int D>
inline Pose<D> pose_from(const double* m) {
  Pose<D> pose;
  for (int r = 0; r < D; ++r) {
    for (int c = 0; c < D; ++c) pose.R(r, c) = m[r * (D + 1) + c];
    pose.t[r] = m[r * (D + 1) + D];
  }
  return pose;
}

// The row-major homogeneous matrix of a pose.
template <int D>
inline std::array<double, (D + 1) * (D + 1)> row_major(const Pose<D>& pose) {
  std::array<double, (D + 1) * (D + 1)> m{};
  for (int r = 0; r < D; ++r) {
    for (int c = 0; c < D; ++c) m[static_cast<size_t>(r * (D + 1) + c)] = pose.R(r, c);
    m[static_cast<size_t>(r * (D + 1) + D)] = pose.t[r];
  }
  m.back() = 1.0;
  return m;
}

}  // namespace stillmap
