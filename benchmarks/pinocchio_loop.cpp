// Forward kinematics and the tip's geometric Jacobian of many poses, pinocchio at its best: one loop in C++.
#include "pinocchio_arm.hpp"

#include <pinocchio/algorithm/jacobian.hpp>

// angles: joints x poses, column by column; out: for each pose the position (3), then the Jacobian (6 x joints).
extern "C" void kinematics(int joints, long poses, const double *placements, const double *angles, double *out) {
  pinocchio::Model model;
  const auto tip = build(model, joints, placements);
  pinocchio::Data data(model);
  Eigen::Matrix<double, 6, Eigen::Dynamic> jacobian = Eigen::Matrix<double, 6, Eigen::Dynamic>::Zero(6, joints);
  const long size = 3 + 6 * joints;
  for (long i = 0; i < poses; ++i) {
    Eigen::Map<const Eigen::VectorXd> q(angles + i * joints, joints);
    pinocchio::computeJointJacobians(model, data, q);
    pinocchio::updateFramePlacement(model, data, tip);
    pinocchio::getFrameJacobian(model, data, tip, pinocchio::LOCAL_WORLD_ALIGNED, jacobian);
    Eigen::Map<Eigen::Vector3d>(out + i * size) = data.oMf[tip].translation();
    Eigen::Map<Eigen::MatrixXd>(out + i * size + 3, 6, joints) = jacobian;
  }
}
