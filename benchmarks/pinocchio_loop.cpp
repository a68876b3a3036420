// Forward kinematics and the tip's geometric Jacobian of many poses, pinocchio at its best: one loop in C++.
// Joints turn about z; placements are rotation (row by row) and translation of each joint in its parent, then the tip's.
#include <pinocchio/algorithm/frames.hpp>
#include <pinocchio/algorithm/jacobian.hpp>
#include <pinocchio/multibody.hpp>

using pinocchio::SE3;
using RowMatrix3 = Eigen::Matrix<double, 3, 3, Eigen::RowMajor>;

static SE3 placement(const double *p) {
  return SE3(Eigen::Map<const RowMatrix3>(p), Eigen::Map<const Eigen::Vector3d>(p + 9));
}

// angles: joints x poses, column by column; out: for each pose the position (3), then the Jacobian (6 x joints).
extern "C" void kinematics(int joints, long poses, const double *placements, const double *angles, double *out) {
  pinocchio::Model model;
  pinocchio::JointIndex last = 0;
  for (int j = 0; j < joints; ++j)
    last = model.addJoint(last, pinocchio::JointModelRZ(), placement(placements + 12 * j), "q" + std::to_string(j));
  const auto tip = model.addFrame(
      pinocchio::Frame("tip", last, 0, placement(placements + 12 * joints), pinocchio::OP_FRAME));
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
