// Forward kinematics alone, pinocchio at its best: one loop in C++, the tip's placement of each pose.
#include "pinocchio_arm.hpp"

#include <pinocchio/algorithm/kinematics.hpp>

// angles: joints x poses, column by column; out: for each pose the tip's rotation (row by row) and position.
extern "C" void kinematics(int joints, long poses, const double *placements, const double *angles, double *out) {
  pinocchio::Model model;
  const auto tip = build(model, joints, placements);
  pinocchio::Data data(model);
  for (long i = 0; i < poses; ++i) {
    Eigen::Map<const Eigen::VectorXd> q(angles + i * joints, joints);
    pinocchio::forwardKinematics(model, data, q);
    const SE3 &at = pinocchio::updateFramePlacement(model, data, tip);
    Eigen::Map<RowMatrix3>(out + i * 12) = at.rotation();
    Eigen::Map<Eigen::Vector3d>(out + i * 12 + 9) = at.translation();
  }
}
