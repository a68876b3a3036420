// Forward kinematics alone, pinocchio at its best: one loop in C++, the tip's placement of each pose.
// Joints turn about z; placements are rotation (row by row) and translation of each joint in its parent, then the tip's.
#include <pinocchio/algorithm/frames.hpp>
#include <pinocchio/algorithm/kinematics.hpp>
#include <pinocchio/multibody.hpp>

using pinocchio::SE3;
using RowMatrix3 = Eigen::Matrix<double, 3, 3, Eigen::RowMajor>;

static SE3 placement(const double *p) {
  return SE3(Eigen::Map<const RowMatrix3>(p), Eigen::Map<const Eigen::Vector3d>(p + 9));
}

// angles: joints x poses, column by column; out: for each pose the tip's rotation (row by row) and position.
extern "C" void kinematics(int joints, long poses, const double *placements, const double *angles, double *out) {
  pinocchio::Model model;
  pinocchio::JointIndex last = 0;
  for (int j = 0; j < joints; ++j)
    last = model.addJoint(last, pinocchio::JointModelRZ(), placement(placements + 12 * j), "q" + std::to_string(j));
  const auto tip = model.addFrame(
      pinocchio::Frame("tip", last, 0, placement(placements + 12 * joints), pinocchio::OP_FRAME));
  pinocchio::Data data(model);
  for (long i = 0; i < poses; ++i) {
    Eigen::Map<const Eigen::VectorXd> q(angles + i * joints, joints);
    pinocchio::forwardKinematics(model, data, q);
    const SE3 &at = pinocchio::updateFramePlacement(model, data, tip);
    Eigen::Map<RowMatrix3>(out + i * 12) = at.rotation();
    Eigen::Map<Eigen::Vector3d>(out + i * 12 + 9) = at.translation();
  }
}
