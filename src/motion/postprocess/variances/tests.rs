use super::*;
use crate::motion::postprocess::noise::VARIANCES;

#[test]
fn variances_are_written_by_name_and_must_be_above_nothing() {
    let text = serde_json::to_string(&VARIANCES).expect("numbers");
    assert!(
        text.starts_with(r#"{"position_m2":{"horizontal":0.0004,"vertical":0.0001},"#),
        "{text}"
    );
    assert_eq!(
        serde_json::from_str::<FusionVariances>(&text).expect("what was written"),
        VARIANCES
    );
    assert_eq!(VARIANCES.unsound(), None);
    let mut zero = FusionVariances::default();
    zero.velocity_m2_s2.vertical = 0.0;
    assert_eq!(zero.unsound(), Some(("velocity_m2_s2", 0.0)));
    zero.position_m2.horizontal = f64::INFINITY;
    assert_eq!(zero.unsound(), Some(("position_m2", f64::INFINITY)));
}
